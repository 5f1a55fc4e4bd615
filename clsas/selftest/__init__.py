"""Self-test: is it right here, and fast? An oracle, extreme scenes, benchmarks and the demo."""
