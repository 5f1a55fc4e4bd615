"""How we know: an independent oracle, extreme cases, the self test, benchmarks, built-in cases."""
