"""Measures of images and of the trade: quality, trade-offs, and assessments of effects."""
