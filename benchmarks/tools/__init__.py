"""Scripts that measurements and the project need: ``python -m
benchmarks.tools.NAME``."""
