"""Export of a model's step to ONNX, and a stream that runs it."""
