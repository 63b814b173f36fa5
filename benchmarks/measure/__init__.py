"""One question a file: ``python -m benchmarks.measure.NAME``."""
