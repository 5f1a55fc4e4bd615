"""From a recording to a focused image: the steps of `clsas process`, with a record of each."""
