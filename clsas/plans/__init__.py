"""Plans as frozen data: how an image will be formed, and the predictions for it."""
