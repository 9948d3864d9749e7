"""Networks behind the finder interfaces (ONNX Runtime)."""
