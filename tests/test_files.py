"""Files are whole or not there."""

import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from offbeat.errors import InputError, one_of, require
from offbeat.files import atomic_folder, atomic_path, writable, write_json


class StopError(Exception):
    """Simulates an error that ends a writer early."""


def stop_while_writing(path):
    with atomic_path(path) as temporary:
        temporary.write_text("half")
        raise StopError


def stop_while_filling(path):
    with atomic_folder(path) as temporary:
        (temporary / "a").write_text("half")
        raise StopError


def test_a_file_that_is_not_finished_leaves_the_old_one_and_no_trace(tmp_path):
    path = tmp_path / "new" / "a.json"
    write_json(path, {"a": 0.1})
    with pytest.raises(StopError):
        stop_while_writing(path)
    assert path.read_text() == '{\n  "a": 0.1\n}\n'
    assert [p.name for p in path.parent.iterdir()] == ["a.json"]


def test_a_folder_that_is_not_finished_leaves_the_old_one_and_no_trace(tmp_path):
    path = tmp_path / "folder"
    for text in ("first", "second"):
        with atomic_folder(path) as temporary:
            (temporary / "a").write_text(text)
        assert (path / "a").read_text() == text
    with pytest.raises(StopError):
        stop_while_filling(path)
    assert (path / "a").read_text() == "second"
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def left_by_a_killed_process(path, suffix=""):
    """A temporary file that is old, as `atomic_path` makes it."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=suffix)
    os.close(handle)
    os.utime(name, (0, 0))
    return Path(name)


def test_what_a_killed_process_left_is_removed_by_the_next_one(tmp_path):
    path = tmp_path / "a.json"
    left = left_by_a_killed_process(path, ".json")
    others = [left_by_a_killed_process(tmp_path / name, ".json") for name in ("b.json", "a.jsonl")]
    (tmp_path / ".a.json.notes").write_text("of somebody else")
    new = Path(tempfile.mkstemp(dir=tmp_path, prefix=".a.json.", suffix=".json")[1])
    write_json(path, 1)
    assert not left.exists()
    assert all(file.exists() for file in (*others, new, tmp_path / ".a.json.notes"))


def test_a_file_that_another_process_writes_is_left_alone(tmp_path):
    path = tmp_path / "a.json"
    with atomic_path(path) as temporary:
        os.utime(temporary, (0, 0))
        code = "import sys; from offbeat.files import write_json; write_json(sys.argv[1], 2)"
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        subprocess.run([sys.executable, "-c", code, str(path)], check=True, env=environment)
        assert temporary.exists()
        temporary.write_text("3")
    assert path.read_text() == "3"


def test_a_folder_that_was_moved_away_and_not_replaced_is_put_back(tmp_path):
    old = tmp_path / ".folder.old.abcdefgh"
    old.mkdir()
    (old / "a").write_text("first")
    left = tmp_path / ".folder.abcdefgh"
    left.mkdir()
    for path in (old, left):
        os.utime(path, (0, 0))
    with pytest.raises(StopError):
        stop_while_filling(tmp_path / "folder")
    assert (tmp_path / "folder" / "a").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_a_full_disk_names_the_file(tmp_path):
    def full():
        with atomic_path(tmp_path / "a.json"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match=r"No space left on device: '.*a.json'"):
        full()
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_said_before_anything_is_made(tmp_path):
    (tmp_path / "file").write_text("")
    for path, folder, message in (
        (tmp_path, False, "is a folder; give the name of a file"),
        (tmp_path / "file", True, "is a file; give the name of a folder"),
        (tmp_path / "file" / "below", False, "file is a file; choose another place"),
    ):
        with pytest.raises(InputError, match=message):
            writable(path, folder=folder)
    writable(tmp_path / "a" / "b" / "c")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_missing_extra_and_an_unknown_name_tell_the_fix():
    with pytest.raises(ImportError, match=r"pip install 'offbeat\[sim\]'"):
        require("offbeat_has_no_such_module", "sim")
    with pytest.raises(InputError, match="one of: heun, rk4; did you mean 'heun'"):
        one_of("solver", "huen", ("rk4", "heun"))
