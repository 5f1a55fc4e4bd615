"""Valid calls of the public API, hostile values for their arguments, and the judgement."""
