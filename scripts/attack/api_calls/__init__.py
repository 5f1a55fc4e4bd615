"""Valid calls of the public API, hostile values for arguments, and the check of outcomes."""
