"""Files: HDF5, scene files, tracks, and recordings in other formats."""
