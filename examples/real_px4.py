"""A PX4 flight log: IMU at 250 Hz and attitude at 83 Hz, each with its own stamps.

    OFFBEAT_DATA=FOLDER python examples/real_px4.py --out results/real_logs --figures docs/figures

The log is `px4_ulog/sample.ulg` (69 s, one of pyulog's). Its board is moved by hand from 2 s to
6.2 s and lies still for the rest, where nothing but noise can be tested. So the moving part is
split in time by itself, and a part without motion is used for training, and tested separately. The
actuator outputs are constant in this log and are left out.
"""

from real_common import Log, data_folder, main

import offbeat as ob

IMU = {
    "gyro, rad/s": tuple(f"sensor_combined.gyro_rad[{i}]" for i in range(3)),
    "acceleration, m/s^2": tuple(f"sensor_combined.accelerometer_m_s2[{i}]" for i in range(3)),
}
ATTITUDE = {
    "attitude rates, rad/s": tuple(
        f"vehicle_attitude.{axis}speed" for axis in ("roll", "pitch", "yaw")
    ),
    "quaternion": tuple(f"vehicle_attitude.q[{i}]" for i in range(4)),
}


def between(log: ob.Dataset, start: float, stop: float) -> ob.Trajectory:
    """The rows of a span of time, s."""
    first, last = log[0].times.searchsorted((start, stop))
    return log[0].slice(int(first), int(last))


def px4(small: bool) -> Log:
    """Moving: 1.5 to 4.2 s train, to 4.8 validate, to 6.2 test. Still: 8-9.5, 10-10.6, 20-22 s."""
    path = data_folder() / "px4_ulog" / "sample.ulg"
    if not path.exists():
        raise SystemExit(f"{path} is not here; set OFFBEAT_DATA to the folder that has px4_ulog")
    log = ob.read(path, topics=["sensor_combined", "vehicle_attitude", "actuator_outputs"])
    groups = IMU | ATTITUDE
    log = log.select([name for names in groups.values() for name in names])
    return Log(
        name="px4",
        log=log,
        train=ob.Dataset((between(log, 1.5, 4.2), between(log, 8, 9.5))),
        validation=ob.Dataset((between(log, 4.2, 4.8), between(log, 10, 10.6))),
        tests={
            "moving": ob.Dataset((between(log, 4.8, 6.2),)),
            "still": ob.Dataset((between(log, 20, 22),)),
        },
        window=150,
        windows=3 if small else 48,
        sensors=(sum(IMU.values(), ()), sum(ATTITUDE.values(), ())),
        silence_s=0.1,
        horizons_s=(0.1, 0.2, 0.5, 1.0),
        groups=groups,
        drawn=(groups["gyro, rad/s"][0], groups["acceleration, m/s^2"][1], groups["quaternion"][1]),
        epochs=60,
        batch_size=8,
    )


if __name__ == "__main__":
    main(px4, __doc__)
