"""Images larger than memory: surveys, stores, patches and workers."""
