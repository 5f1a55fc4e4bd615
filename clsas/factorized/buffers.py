"""Device buffers of a factorized image."""

CHUNK = 32
"""Channels that a stage adds up before it hands on the sums, and takes up those still open."""
LEAST_BATCH = 2
"""Roots that are formed together at least, if they fit the memory: fewer commands."""
