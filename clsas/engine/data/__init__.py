"""Range lines, grids, images, beams and tracks, and checks of arguments."""
