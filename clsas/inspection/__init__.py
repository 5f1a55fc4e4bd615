"""Inspections: what a recording says about its own geometry, clocks and conventions."""
