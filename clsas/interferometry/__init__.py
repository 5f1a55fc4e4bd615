"""Interferograms of two receiver banks, and heights of the seabed."""
