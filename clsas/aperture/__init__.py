"""The aperture: mean tracks, and the few virtual channels that stand for many channels."""
