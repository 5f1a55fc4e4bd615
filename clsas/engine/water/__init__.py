"""Sound speed that varies with depth: rays, and what replaces them in an image."""
