"""A Unitree G1 humanoid (LeRobot set): arms at 30 Hz, and hands whose slower values are repeated.

    OFFBEAT_DATA=FOLDER python examples/real_g1.py --out results/real_logs --figures docs/figures

The set is `unitree_g1_lerobot_v21` (100 episodes, 26 states). The hands repeat their value in about
four rows of five; repeats are masked, so that no predictor is scored for repeating them.
"""

from real_common import Log, data_folder, main

import offbeat as ob


def g1(small: bool) -> Log:
    """Of 100 episodes 70 train, 15 validate (a window each), 15 test, drawn at random."""
    path = data_folder() / "unitree_g1_lerobot_v21"
    if not path.exists():
        raise SystemExit(f"{path} is not here; set OFFBEAT_DATA to the folder that has it")
    episodes = list(range(12)) if small else None
    log = ob.read(
        path,
        episodes=episodes,
        columns=["observation.state"],
        include_actions=False,
        repeated="mask",
    )
    hands = tuple(name for name in log.names if "Hand" in name)
    arms = tuple(name for name in log.names if "Hand" not in name)
    train, validation, test = ob.split(log, seed=0)

    def of(names: tuple[str, ...], side: str) -> tuple[str, ...]:
        return tuple(name for name in names if side in name)

    return Log(
        name="g1",
        log=log,
        train=train,
        validation=ob.windows(validation, 200, seed=0),
        tests={"test": ob.windows(test, 200, seed=0)},
        window=100,
        windows=1,
        sensors=tuple(of(names, side) for names in (arms, hands) for side in ("Left", "Right")),
        silence_s=0.5,
        horizons_s=(0.1, 0.2, 0.5, 1.0),
        groups={"arm joints, rad": arms, "hand joints, 0 to 1": hands},
        drawn=("kRightElbow", "kRightWristYaw", "kRightHandIndex"),
        epochs=40,
        batch_size=14,
    )


if __name__ == "__main__":
    main(g1, __doc__)
