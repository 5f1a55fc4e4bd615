"""Signals: echoes and their compression, spectra, interpolation in range."""
