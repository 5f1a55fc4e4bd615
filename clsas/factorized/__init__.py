"""The image, fast: the tree of subimages, its filters, and the run of a plan."""
