"""Files are whole or not there."""

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
