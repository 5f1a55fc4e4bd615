"""What an image shows: quality, trade-offs, effects, pictures."""
