"""Checks of a recording's track, samples and units before an image is formed."""
