"""Kernel ridge regression on what was observed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.baselines.base import BASELINES, Array, as_kind, namespace, product
from offbeat.baselines.examples import Examples
from offbeat.baselines.ridge import Ridge

CENTRES, MOST, FEWEST = 1_600, 400, 100
"""Centres times channels, and most and fewest centres."""

WIDTHS = (0.5, 1.0, 2.0)
"""Widths of the kernel, in units of the root mean square of the inputs."""

INPUTS = (0, 4)
"""Features of a channel that the kernel compares: its last value, and how it moved of late."""

SMALLEST = 1e-6
"""Eigenvalues of the kernel matrix are at least this part of the largest."""


class KernelRidge(Ridge):
    r"""Ridge regression of `Ridge`, with a function of where all channels are and move to.

    To the features of all channels come those of a kernel, by Nystroem's method (Williams and
    Seeger, 2001): for inputs z, the last value of every channel and its difference from its
    average over some gaps, :math:`K(z, C) K(C, C)^{-1/2}` for centres C among the training states
    and K the mean of Gaussian kernels of three widths. With a ridge penalty this is kernel ridge
    regression; it learns motions that depend on the place, as of repeated strokes and tasks. There
    are 400 centres for up to 4 channels, fewer for more, and 100 from 16 on.
    """

    cost = 120.0

    centres: Array  # (centres, inputs)
    root: Array  # (centres, centres) K(C, C)^(-1/2)

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        return {**super().arrays(), "centres": self.centres, "root": self.root}

    def shared(self, features: Any) -> Any:
        """(batch, shared features) those of all channels, a 1, and those of the kernel."""
        plain = super().shared(features)
        inputs = _inputs(features)
        near = gaussians(inputs, as_kind(self.centres, inputs))
        kernel = product(near, as_kind(self.root, inputs))
        return namespace(plain).concatenate([plain, kernel], -1)

    def _solve(self, found: Examples, features: Array, alike: Array) -> None:
        inputs = _inputs(features)
        most = int(np.clip(CENTRES // features.shape[1], FEWEST, MOST))
        some = np.random.default_rng(0).permutation(len(inputs))[:most]
        self.centres = inputs[some].astype(np.float64)
        self.root = whitening(gaussians(self.centres, self.centres))
        super()._solve(found, features, alike)

    def _columns(self, group: list[int], alike: Array, each: int) -> NDArray[np.int64]:
        plain = len(alike) * each + 1
        kernel = plain + np.arange(len(self.centres))
        return np.concatenate([super()._columns(group, alike, each), kernel])


def _inputs(features: Any) -> Any:
    """(batch, inputs) of the kernel."""
    return features[..., list(INPUTS)].reshape(features.shape[0], -1)


def gaussians(inputs: Any, centres: Any) -> Any:
    """Mean of Gaussian kernels of several widths.

    Args:
        inputs: (batch, inputs).
        centres: (centres, inputs).

    Returns:
        (batch, centres).
    """
    xp = namespace(inputs)
    square = (inputs**2).sum(-1)[:, None] + (centres**2).sum(-1) - product(2 * inputs, centres.T)
    square = xp.clip(square, 0.0, np.inf) / centres.shape[1]
    return sum(xp.exp(square / (-2 * width**2)) for width in WIDTHS) / len(WIDTHS)


def whitening(kernel: Array) -> Array:
    """The inverse root of a kernel matrix, of limited condition.

    Args:
        kernel: (centres, centres).
    """
    values, vectors = np.linalg.eigh(kernel)
    values = np.maximum(values, SMALLEST * values[-1])
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)


BASELINES.register("kernel_ridge", KernelRidge)
