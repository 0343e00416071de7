"""How far a traced path is from a demonstration: swept error area, Fréchet distance, DTW."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def swept_error_area(path: ArrayLike, demonstration: ArrayLike) -> float:
    """Area between two paths that are sampled at the same times.

    The sum of the areas of the tetragons between two pairs of consecutive points: equation 14 of
    Khansari-Zadeh and Billard 2014 (Robotics and Autonomous Systems 62(6)).

    Args:
        path: (rows, 2).
        demonstration: (rows, 2).

    Returns:
        The area, in squared units of the points.

    Raises:
        ValueError: the shapes differ.
    """
    a, b = (np.asarray(each, dtype=np.float64) for each in (path, demonstration))
    if a.shape != b.shape or a.shape[1:] != (2,):
        raise ValueError(f"expected two paths of (rows, 2), got {a.shape} and {b.shape}")
    return float((_triangles(a[:-1], a[1:], b[:-1]) + _triangles(b[:-1], b[1:], a[1:])).sum())


def _triangles(p: NDArray[np.float64], q: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray:
    """(n,) areas of the triangles of three (n, 2) arrays of points."""
    u, v = q - p, r - p
    return np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2


def distances(path: NDArray[np.float64], demonstration: NDArray[np.float64]) -> dict[str, float]:
    """Swept error area (mm^2), Fréchet distance (mm), and DTW distance per row (mm).

    The Fréchet distance is the discrete one of shapely, DTW that of dtaidistance with Euclidean
    distances between points.

    Args:
        path: (rows, 2) mm.
        demonstration: (rows, 2) mm, at the same times.
    """
    import shapely
    from dtaidistance import dtw_ndim

    lines = [shapely.LineString(each) for each in (path, demonstration)]
    aligned = dtw_ndim.distance(path, demonstration, use_c=True, inner_dist="euclidean")
    return {
        "area": swept_error_area(path, demonstration),
        "frechet": float(shapely.frechet_distance(*lines)),
        "dtw": float(aligned) / len(demonstration),
    }
