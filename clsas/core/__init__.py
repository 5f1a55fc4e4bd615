"""What the data are: range lines, grids, images, and the checks, files and numbers all share."""
