"""The scan over rows: one signature, and the bodies that run it."""

from __future__ import annotations

from torch import Tensor

from offbeat.kernels import reference, written_out
from offbeat.kernels.reference import perceptron
from offbeat.kernels.spec import (
    LARGEST_EXPONENT,
    DecayRows,
    Layers,
    ScanRows,
    ScanSpec,
    ScanWeights,
)

__all__ = [
    "LARGEST_EXPONENT",
    "DecayRows",
    "Layers",
    "ScanRows",
    "ScanSpec",
    "ScanWeights",
    "perceptron",
    "scan",
]


def scan(
    spec: ScanSpec, weights: ScanWeights, rows: ScanRows, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Carries a batch of states over all rows, with the fastest body that can.

    Args:
        spec: the shape of the scan.
        weights: what meets the state.
        rows: what is read at each row.
        state: (batch, state_size) before the first row.

    Returns:
        Two tensors (rows, batch, state_size): the state carried to each row, before anything is
        observed there, and the state after the row.
    """
    body = written_out.scan if written_out.supports(spec, rows) else reference.scan
    return body(spec, weights, rows, state)
