"""What is measured, one script each: ``python -m benchmarks.NAME``."""

import me2e_compress  # noqa: F401  before onnxruntime, whose telemetry that switches off
