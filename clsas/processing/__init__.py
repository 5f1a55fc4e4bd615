"""From a recording to a focused image: the steps of `clsas process`, recorded and resumable."""
