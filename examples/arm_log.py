"""Writes the log of a simulated arm as CSV; python examples/arm_log.py arm.csv --seconds 240.

An arm of six joints picks objects up and puts them down. Joints report at 100 Hz, the wrist's
inertial unit at 200 Hz, the gripper at 20 Hz, each at stamps of its own, and each drops out at
times. `offbeat.data.arm_log` describes the motion and the sensors.
"""

from __future__ import annotations

import argparse

from offbeat.data.arm_log import CHANNELS, write

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    parser.add_argument("--seconds", type=float, default=240.0)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    write(chosen.out, chosen.seconds, seed=chosen.seed)
    print(f"{chosen.out}: {chosen.seconds:g} s of {sum(map(len, CHANNELS.values()))} channels")
