"""ONNX: a model's step as one file, and what runs it."""
