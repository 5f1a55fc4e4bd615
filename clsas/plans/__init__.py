"""Plans: what has been decided about an image, and what is predicted of it, as frozen data."""
