"""Signals: echoes and their compression, spectra, and interpolation in range."""
