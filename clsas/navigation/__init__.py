"""Corrections of the track from the echoes: known points, micronavigation, and autofocus."""
