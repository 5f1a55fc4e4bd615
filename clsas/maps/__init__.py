"""Images on maps: GeoTIFF, netCDF, and pictures with world files, for other programs."""
