"""What is measured, one script each: ``python -m benchmarks.FOLDER.NAME``."""

import me2e_compress  # noqa: F401  before onnxruntime, whose telemetry that switches off
