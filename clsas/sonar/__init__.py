"""Sonars: pulse and elements, tracks, sampling limits, beam weights and visibility."""
