"""How lines are sampled: compression, spectra, interpolation in range."""
