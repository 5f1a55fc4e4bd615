"""Range lines, grids and images, with the checks, files and numbers that all rooms share."""
