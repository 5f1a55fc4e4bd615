"""Factorized images: the tree of subimages, its geometry, and the run of a plan on a device."""
