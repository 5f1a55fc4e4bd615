"""Corrections of the track by the echoes themselves: micronavigation and autofocus."""
