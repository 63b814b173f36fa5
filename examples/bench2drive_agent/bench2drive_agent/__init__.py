"""An ONNX graph as an agent of Bench2Drive, with the latency of its device."""
