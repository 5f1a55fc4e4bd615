"""In and out: HDF5 and scene files."""
