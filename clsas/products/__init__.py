"""Quality measures, trade-offs, effects and pictures of images."""
