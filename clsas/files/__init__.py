"""Files: HDF5, scene files and tracks."""
