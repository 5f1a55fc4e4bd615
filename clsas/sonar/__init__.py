"""Sonars: pulses and elements, tracks, sampling limits, beam weights and visibility."""
