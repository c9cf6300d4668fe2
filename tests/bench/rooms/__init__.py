"""Furnished closed rooms by path tracing, as ground truth that nothing was tuned to: `python -m tests.bench.rooms`."""
