"""Exact imaging: backprojection, the float64 reference, and the wavenumber imager."""
