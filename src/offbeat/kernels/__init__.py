"""The scan over rows: one signature, one body so far (PyTorch, the reference)."""

from offbeat.kernels.reference import perceptron, scan
from offbeat.kernels.spec import LARGEST_EXPONENT, DecayRows, Layers, ScanRows, ScanSpec, ScanWeights

__all__ = ["LARGEST_EXPONENT", "DecayRows", "Layers", "ScanRows", "ScanSpec", "ScanWeights", "perceptron", "scan"]
