"""Trials: an independent oracle, extreme cases, the self-test, benchmarks and built-in cases."""
