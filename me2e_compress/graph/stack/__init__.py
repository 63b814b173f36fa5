"""Several ONNX files as one graph: joined on reading, split on writing."""
