"""Controllers that come as ONNX files, and ours written as such."""
