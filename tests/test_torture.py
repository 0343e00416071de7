"""Some kills at random file operations; `make torture` does 200."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from offbeat.cli import app
from offbeat.files import atomic_folder, clean


@pytest.mark.skipif(sys.platform != "linux", reason="the test forks processes")
def test_commands_that_are_killed_and_resumed_leave_what_an_undisturbed_run_leaves() -> None:
    """In a process of its own, which forks before torch has computed."""
    command = [sys.executable, str(Path(__file__).with_name("torture.py")), "--kills", "6"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [*command, "--commands", "train", "sweep", "impute", "--seed", "3"],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("2 x same") == 3


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_is_one_line_with_the_file_and_what_to_do(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(code, "[Errno 28] as libraries say it")

    monkeypatch.setattr("pyarrow.parquet.ParquetWriter.write_table", full)
    out = tmp_path / "walks.parquet"
    arguments = ["simulate", str(out), "--n_trajectories", "1", "--rows", "3"]
    assert app.main(arguments) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"offbeat: error: {out} can't be written: {os.strerror(code)}; free some space, then "
        "repeat the command"
    )
    assert not list(tmp_path.iterdir())


def test_what_killed_processes_left_in_a_folder_is_removed_and_nothing_else(
    tmp_path: Path,
) -> None:
    inside = tmp_path / "checkpoints"
    inside.mkdir()
    left = [tmp_path / ".log.csv.abcdefgh.csv", inside / ".steps-000000002.a1_bcdef"]
    left[0].write_text("half")
    left[1].mkdir()
    (left[1] / "model.safetensors").write_text("half")
    moved = inside / ".steps-000000001.old.abcdefgh"  # and its successor was not put there
    moved.mkdir()
    kept = [tmp_path / ".lock", tmp_path / ".notes.csv", inside / ".gitignore"]
    for path in kept:
        path.write_text("")
    for path in (*left, moved, *kept):
        os.utime(path, (0, 0))
    new = tmp_path / ".log.csv.12345678.csv"  # it may be another process' that just began
    new.write_text("")
    with atomic_folder(inside / "steps-000000003") as used:
        os.utime(used, (0, 0))
        clean(tmp_path)
        assert used.exists()
        (used / "a").write_text("")
    assert not any(path.exists() for path in left)
    assert (inside / "steps-000000001").is_dir()
    assert all(path.exists() for path in (*kept, new))
