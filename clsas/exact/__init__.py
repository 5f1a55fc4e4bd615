"""The image, whatever it takes: backprojection, float64 reference, wavenumber imager."""
