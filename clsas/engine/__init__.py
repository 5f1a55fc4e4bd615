"""The engine: from lines to an image, with NumPy, SciPy and PyOpenCL alone."""
