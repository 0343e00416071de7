"""Animations of a robot next to its prediction, rendered by MuJoCo.

MuJoCo selects its rendering backend when it is imported, and a backend that does not
work can kill the process. So rendering runs in a separate process, once per backend until one
works.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.data.robots import load_model
from offbeat.errors import InputError, MissingExtraError, require
from offbeat.files import atomic_path

if TYPE_CHECKING:
    from PIL.Image import Image

_PANEL = (320, 264)  # width and height of one robot's view, pixels
_TOP, _BOTTOM, _GAP = 46, 40, 4  # strips for text above and below, and between the views
_SHORTEST_FRAME_S = 0.02  # players show shorter frames for a tenth of a second
_HOLD_LAST_MS = 1000
_COLOURS = 256
_PAPER, _INK, _PALE, _SEEN = "#FFFFFF", "#1A1A1A", "#B8B8B8", "#0072B2"
_SKY, _GHOST = (236, 240, 245), (0.1, 0.35, 0.8, 0.45)
_BEHIND_M = 0.1  # the camera looks along y
_RENDER_TIMEOUT_S = 180


def side_by_side(
    robot: str,
    truth_qpos: ArrayLike,
    predicted_qpos: ArrayLike,
    path: str | Path,
    *,
    times: ArrayLike,
    observed: ArrayLike | None = None,
    labels: tuple[str, str] = ("simulated", "predicted"),
    caption: str = "",
    speed: float = 1 / 8,
) -> Path:
    """Writes a GIF of the true robot and the predicted one, one frame per row.

    A transparent copy of the true one is behind the predicted one. The camera looks from the side
    and follows the true torso in both views. Below, a line of time shows which rows were observed.

    Args:
        robot: one of `offbeat.data.robots.ROBOTS`.
        truth_qpos: (rows, nq) positions, in the order of the robot's channels.
        predicted_qpos: (rows, nq) the same, predicted.
        path: of the GIF, written atomically.
        times: (rows,) s, strictly increasing; frames last as long as the rows, slowed down.
        observed: (rows,) bool, rows that the model observed; by default every row.
        labels: what the left and the right view show.
        caption: text above the views: what is predicted, by which model, and how.
        speed: 1/8 plays eight times slower than real time.

    Raises:
        InputError: shapes disagree, values are not finite, or frames would be too short to show.
        MissingExtraError: mujoco is not installed, or no rendering backend works.
    """
    model = load_model(robot)
    truth = _positions("truth_qpos", truth_qpos, model.nq)
    predicted = _positions("predicted_qpos", predicted_qpos, model.nq)
    clock = np.asarray(times, dtype=np.float64)
    seen = np.ones(len(truth), bool) if observed is None else np.asarray(observed, dtype=bool)
    if not len(truth) == len(predicted) == len(clock) == len(seen):
        raise InputError(
            f"truth, prediction, times and observed need one row per frame, got {len(truth)}, "
            f"{len(predicted)}, {len(clock)} and {len(seen)} rows"
        )
    durations = _durations_ms(clock, speed)
    views = _render_any(robot, truth, predicted)
    frames = []
    for row in range(len(clock)):
        status = f"t = {1e3 * (clock[row] - clock[0]):.0f} ms    {_fraction(speed)} speed"
        frame = _page(views[row], labels, caption, status)
        _timeline(frame, clock, seen, row)
        frames.append(frame)
    return _write_gif(frames, durations, Path(path))


def stills(robot: str, qpos: ArrayLike) -> NDArray[np.uint8]:
    """Pictures of a robot, one per row, seen from the side; the camera follows the torso.

    Args:
        robot: one of `offbeat.data.robots.ROBOTS`.
        qpos: (rows, nq) positions, in the order of the robot's channels.

    Returns:
        (rows, height, width, 3) red, green, blue.

    Raises:
        InputError: `qpos` is not finite or of another shape.
        MissingExtraError: mujoco is not installed, or no rendering backend works.
    """
    positions = _positions("qpos", qpos, load_model(robot).nq)
    return _render_any(robot, positions, positions)[:, 0]


def render_frames(request: str, answer: str) -> None:
    """Renders a request; runs in a process whose `MUJOCO_GL` is set.

    Args:
        request: npz file with `robot`, `truth` (rows, nq) and `predicted` (rows, nq).
        answer: npy file to write, (rows, 2, height, width, 3) uint8: the true and the predicted.
    """
    mujoco = require("mujoco", "sim")
    with np.load(request) as asked:
        model = load_model(str(asked["robot"]))
        truth, predicted = asked["truth"], asked["predicted"]
    _brighten(mujoco, model)
    model.vis.quality.shadowsize = 1024  # larger ones take a third of the time
    states = [mujoco.MjData(model) for _ in range(2)]
    torso = _torso_path(mujoco, model, states[0], truth)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth, camera.elevation = 90.0, -6.0
    camera.distance = 1.3 * model.stat.extent
    height = (torso[:, 2].min() + torso[:, 2].max()) / 2
    width, tall = _PANEL
    frames = np.empty((len(truth), 2, tall, width, 3), dtype=np.uint8)
    renderer = mujoco.Renderer(model, tall, width)
    try:
        for row, (true, guess) in enumerate(zip(truth, predicted, strict=True)):
            for state, qpos in zip(states, (true, guess), strict=True):
                state.qpos[:] = qpos
                mujoco.mj_forward(model, state)
            camera.lookat[:] = (torso[row, 0], torso[row, 1], height)
            for side, state in enumerate(states):
                renderer.update_scene(state, camera)
                # A moving reflection doubles the size of the file.
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
                if side:
                    _add_ghost(mujoco, model, states[0], renderer.scene)
                renderer.render(out=frames[row, side])
    finally:
        renderer.close()  # EGL is not available any more at exit
    np.save(answer, frames)


def _brighten(mujoco: Any, model: Any) -> None:
    """Makes the sky plain and the floor pale: fewer colours, and a clearer robot."""
    for texture, kind in enumerate(model.tex_type):
        start, channels = int(model.tex_adr[texture]), int(model.tex_nchannel[texture])
        pixels = int(model.tex_height[texture] * model.tex_width[texture])
        colours = model.tex_data[start : start + pixels * channels].reshape(pixels, channels)[:, :3]
        is_sky = kind == mujoco.mjtTexture.mjTEXTURE_SKYBOX
        colours[:] = _SKY if is_sky else 0.5 * colours + 0.5 * np.array(_SKY)


def _torso_path(mujoco: Any, model: Any, data: Any, qpos: NDArray[Any]) -> NDArray[np.float64]:
    path = np.empty((len(qpos), 3))
    for row, position in enumerate(qpos):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        path[row] = data.xpos[1]  # body 0 is the world, body 1 the root of the robot
    return path


def _add_ghost(mujoco: Any, model: Any, data: Any, scene: Any) -> None:
    first = scene.ngeom
    dynamic = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
    mujoco.mjv_addGeoms(model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), dynamic, scene)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:] = _GHOST
        geom.pos[1] += _BEHIND_M


# --- a process that can render --------------------------------------------------------------------


def _render_any(
    robot: str, truth: NDArray[np.float64], predicted: NDArray[np.float64]
) -> NDArray[np.uint8]:
    chosen = os.environ.get("MUJOCO_GL")
    # Other systems than Linux have one backend, which MuJoCo uses by default.
    backends = (chosen,) if chosen else ("egl", "osmesa") if sys.platform == "linux" else ("",)
    failures = []
    with tempfile.TemporaryDirectory(prefix="offbeat-") as folder:
        request, answer = Path(folder) / "request.npz", Path(folder) / "frames.npy"
        np.savez(request, robot=robot, truth=truth, predicted=predicted)
        for backend in backends:
            failure = _render_with(backend, request, answer)
            if failure is None:
                frames: NDArray[np.uint8] = np.load(answer)
                return frames
            failures.append(f"{backend or 'the default'}: {failure}")
    fix = (
        "unset MUJOCO_GL, or set it to egl or osmesa"
        if chosen
        else "install a software renderer, on Debian: apt-get install libegl1 libosmesa6"
    )
    raise MissingExtraError(f"MuJoCo cannot render here ({'; '.join(failures)}); {fix}")


def _render_with(backend: str, request: Path, answer: Path) -> str | None:
    """Renders in a new process; returns None, or why it failed."""
    code = "import sys; from offbeat.plots.animation import render_frames as r; r(*sys.argv[1:])"
    environment = {**os.environ, "MUJOCO_GL": backend}
    # The child must import this copy of the package, even if it is not installed.
    here = str(Path(__file__).parents[2])
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, str(request), str(answer)],
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_RENDER_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {_RENDER_TIMEOUT_S} s"
    if done.returncode == 0 and answer.exists():
        return None
    said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return said[-1][:160] if said else f"exit code {done.returncode}"


# --- the page around the views --------------------------------------------------------------------


def _page(views: NDArray[np.uint8], labels: tuple[str, str], caption: str, status: str) -> Image:
    from PIL import Image, ImageDraw, ImageFont

    width, tall = _PANEL
    page = Image.new("RGB", (2 * width + _GAP, _TOP + tall + _BOTTOM), _PAPER)
    draw = ImageDraw.Draw(page)
    large, small = ImageFont.load_default(15), ImageFont.load_default(13)
    draw.text((8, 5), caption, fill=_INK, font=large)
    draw.text((8, 25), status, fill=_INK, font=small)
    for side, label in enumerate(labels):
        left = side * (width + _GAP)
        page.paste(Image.fromarray(views[side]), (left, _TOP))
        draw.text((left + 8, _TOP + 6), label, fill=_INK, font=large)
    return page


def _timeline(page: Image, times: NDArray[np.float64], seen: NDArray[np.bool_], row: int) -> None:
    """Draws a tick per row, tall and blue if observed, a cursor, and the status text."""
    from PIL import ImageDraw, ImageFont

    draw = ImageDraw.Draw(page)
    top = page.height - _BOTTOM + 8
    left, right = 132, page.width - 12
    span = max(times[-1] - times[0], 1e-12)
    for tick in range(len(times)):
        x = left + round((right - left) * float((times[tick] - times[0]) / span))
        height = 16 if seen[tick] else 5
        colour = _SEEN if seen[tick] else _PALE
        draw.line((x, top + 18 - height, x, top + 18), fill=colour, width=2)
        if tick == row:
            draw.polygon([(x - 5, top + 28), (x + 6, top + 28), (x, top + 21)], fill=_INK)
    dot = (10, top + 5, 20, top + 15)
    draw.ellipse(dot, fill=_SEEN if seen[row] else _PAPER, outline=_SEEN if seen[row] else _PALE)
    words = "row observed" if seen[row] else "row masked"
    draw.text((28, top + 2), words, fill=_INK, font=ImageFont.load_default(13))


def _write_gif(frames: list[Image], durations_ms: list[int], path: Path) -> Path:
    """Uses one palette for all frames, which avoids flicker and large files."""
    from PIL import Image

    sample = frames[:: max(1, len(frames) // 8)]
    montage = Image.new("RGB", (frames[0].width, frames[0].height * len(sample)))
    for i, frame in enumerate(sample):
        montage.paste(frame, (0, i * frame.height))
    palette = montage.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    with atomic_path(path) as temporary:
        reduced[0].save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=reduced[1:],
            duration=durations_ms,
            loop=0,
        )
    return path


def _durations_ms(times: NDArray[np.float64], speed: float) -> list[int]:
    if not 0 < speed < float("inf"):
        raise InputError(f"speed must be positive, got {speed!r}; 1/8 plays eight times slower")
    gaps = np.diff(times)
    if times.ndim != 1 or not np.isfinite(times).all() or (gaps <= 0).any():
        raise InputError("times of an animation must be finite and increase strictly")
    if len(gaps) and gaps.min() / speed < _SHORTEST_FRAME_S * (1 - 1e-9):
        raise InputError(
            f"at speed {speed:g} a row of {gaps.min():g} s would be shown for less than "
            f"{_SHORTEST_FRAME_S:g} s; use a speed of at most {gaps.min() / _SHORTEST_FRAME_S:g}"
        )
    # GIF has units of 0.01 s: the ends are rounded, so that errors do not accumulate.
    ends = np.round((times - times[0]) / speed * 100).astype(int) * 10
    return [*np.diff(ends).tolist(), _HOLD_LAST_MS]


def _fraction(speed: float) -> str:
    return str(Fraction(speed).limit_denominator(100))


def _positions(name: str, value: ArrayLike, nq: int) -> NDArray[np.float64]:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != nq or not len(array):
        raise InputError(f"{name} must have shape (rows, {nq}), got {array.shape}")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise InputError(f"{name} is not finite at row {int(bad.argmax())}")
    return array
