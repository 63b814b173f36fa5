"""Run a stack of several ONNX files as one model."""
