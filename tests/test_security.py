"""Files from anyone: what is refused before it is opened, allocated, believed or printed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import fuzz
import numpy as np
import pytest
import torch
from corpus import tables
from log_writers import OPTIONS, WRITERS
from safetensors.torch import load, save

from offbeat.cli.app import main
from offbeat.data.readers import READERS, read
from offbeat.data.source import read_json
from offbeat.errors import FileFormatError, InputError, OffbeatError, printable
from offbeat.models.checkpoint import CONFIG, TENSORS, _digest, load_model
from offbeat.tables import escape_markdown

SUFFIXES = sorted({suffix for r in READERS.values() for suffix in r.suffixes} - {"/"})


@pytest.mark.timeout(30)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_pipes_and_devices_are_not_opened(suffix, tmp_path):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(FileFormatError, match="is a pipe or a device, expected a file"):
            read(tmp_path / f"{name}{suffix}")


@pytest.mark.timeout(30)
@pytest.mark.parametrize("place", ["mav0/imu0/data.csv", "meta/info.json", "main_data.hdf5"])
def test_pipes_inside_a_folder_are_not_opened(place, tmp_path):
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(tmp_path / place)
    with pytest.raises(FileFormatError):
        read(tmp_path)


@pytest.mark.timeout(30)
@pytest.mark.parametrize("option", ["--config", "--model", "--split"])
def test_a_pipe_is_no_config(option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    assert main(["train", "none.csv", "out", option, "pipe"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_path_that_holds_a_byte_of_0_is_an_error_of_one_line():
    with pytest.raises(FileFormatError, match="can't be read"):
        read("a\0b.csv")


@pytest.mark.timeout(60)
def test_columns_and_arrays_without_end_are_refused_early(tmp_path):
    names = ",".join(f"c{i}" for i in range(100_000))
    path = tmp_path / "wide.csv"
    path.write_text(f"time,{names}\n0{',1' * 100_000}\n")
    with pytest.raises(FileFormatError, match="more than 20000; choose some with channels="):
        read(path)
    assert read(path, channels=["c7"])[0].values.tolist() == [[1.0]]
    with zipfile.ZipFile(tmp_path / "many.npz", "w") as file:
        for i in range(10_001):
            file.writestr(f"c{i}.npy", b"")
    with pytest.raises(FileFormatError, match="holds 10001 arrays, more than 10000"):
        read(tmp_path / "many.npz")


@pytest.mark.timeout(60)
@pytest.mark.parametrize("start", ["", "time,x\n0,1\n"])
def test_a_line_without_end_is_refused_before_it_fills_the_memory(start, tmp_path):
    path = tmp_path / "long.csv"
    path.write_text(start + "1" * (1 << 24))
    with pytest.raises(FileFormatError, match="a line of more than 16777216 characters"):
        read(path)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' + "9" * 5000 + "}", "nul", "\x00"])
def test_json_that_is_none_is_an_error_of_one_line(text, tmp_path):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(FileFormatError, match="it is no JSON") as error:
        read_json(tmp_path / "a.json")
    assert str(error.value).isprintable()


def one_line(text):
    return len(text) < 700 and "\n" not in text and printable(text) == text


WRONG = (
    *(3, -1, 2.5, float("nan"), True, None, "", "x", [], ["x"], [None], {}, {"a": 1}, {1: 2}),
    *(b"x", object(), [["a"]], 10**400, np.array([1, 2])),
)


@pytest.mark.parametrize("variant", WRITERS)
def test_an_option_of_any_type_is_taken_or_refused_in_one_line(variant, tmp_path):
    reader = READERS[variant.split()[0]]
    path = WRITERS[variant](tmp_path / "walk", fuzz.STAMPS, fuzz.VALUES)
    said = {}
    for option in reader.options:
        for value in WRONG:
            try:
                read(path, **{**OPTIONS.get(variant, {}), option: value})
            except OffbeatError as error:
                said[option, repr(value)[:20]] = str(error)
    assert [key for key, text in said.items() if not one_line(text)] == []


ESCAPE = "\x1b[31mX\x1b[2J\x07"


class TestNames:
    def test_with_control_characters_reach_no_terminal(self, tmp_path, capfd, monkeypatch):
        monkeypatch.chdir(tmp_path)
        columns = {"time": tables.TIMES, ESCAPE: tables.X, "y\u202ez": tables.Y, "t\x9b": tables.Y}
        columns["mode\x1b"] = ["a"] * len(tables.X)
        path = tables.write_csv(tmp_path / "log", columns)
        assert main(["inspect", str(path)]) == 0
        assert main(["inspect", str(path), "--reader.channels", "none"]) == 2
        assert main(["inspect", f"{ESCAPE}.csv"]) == 2
        out, err = capfd.readouterr()
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", out + err)
        assert "\\x1b[31mX" in out

    def test_with_dollar_signs_and_control_characters_do_not_break_a_figure(self, tmp_path):
        columns = {"time": tables.TIMES, "$x^{$": tables.X, "a\x1b$b": tables.Y}
        path = tables.write_csv(tmp_path / "log", columns)
        for suffix in ("png", "svg", "pdf"):
            assert main(["inspect", str(path), "--out", str(tmp_path / f"a.{suffix}")]) == 0
        drawn = (tmp_path / "a.svg").read_text()
        assert "$x^{$" in drawn
        assert "\x1b" not in drawn

    def test_are_escaped_once_in_markdown(self):
        text = "<script>alert(1)</script> [a](javascript:b) | \x1b"
        escaped = escape_markdown(text)
        assert escaped == ("&lt;script>alert(1)&lt;/script> [a]\\(javascript:b) \\| \\x1b")
        assert escape_markdown("p < 0.01, q[0]") == "p < 0.01, q[0]"

    def test_that_are_printable_stay_as_they_are(self):
        for text in (
            "q_\N{DEGREE SIGN} \N{GREEK SMALL LETTER OMEGA}",
            "7\N{THIN SPACE}%",
            "a\tb\n",
        ):
            assert printable(text) == text
        assert printable("\x85\u2028\u202e") == "\\x85\\u2028\\u202e"


class TestForgedCheckpoints:
    """Their checksums fit, as a forger would make them."""

    @pytest.fixture
    def folder(self, tmp_path):
        return fuzz.make_checkpoint(tmp_path)

    def forge(self, folder, change=None, tensors=None):
        record = json.loads((folder / CONFIG).read_text())
        record.pop("config_sha256")
        if tensors is not None:
            data = tensors if isinstance(tensors, bytes) else save(tensors)
            (folder / TENSORS).write_bytes(data)
            record["tensors_sha256"] = hashlib.sha256(data).hexdigest()
        if change is not None:
            change(record)
        record["config_sha256"] = _digest(record)
        (folder / CONFIG).write_text(json.dumps(record))

    def refused(self, folder, message, capsys):
        with pytest.raises(FileFormatError, match=message) as error:
            load_model(folder)
        assert str(error.value).isprintable()
        log = folder.parent / "log.csv"
        log.write_text("time,x,y\n" + tables.BODY)
        assert main(["evaluate", str(folder), str(log)]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_with_weights_that_are_not_finite_are_refused(self, folder, value, capsys):
        tensors = load((folder / TENSORS).read_bytes())
        first = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
        tensors[first].view(-1)[0] = value
        self.forge(folder, tensors=tensors)
        self.refused(folder, f"weights that are not finite, in {first}", capsys)

    @pytest.mark.parametrize(
        "field",
        ["tensors_sha256", "dtype", "name", "model", "names", "units", "roles", "statistics",
         "scaler", "transforms"],
    )  # fmt: skip
    def test_without_a_field_are_refused(self, folder, field, capsys):
        self.forge(folder, lambda record: record.pop(field))
        self.refused(folder, "damaged", capsys)

    @pytest.mark.parametrize("value", [None, 3, "x", [], {}, [None], {"a": None}, -1e308])
    @pytest.mark.parametrize(
        "field", ["dtype", "name", "model", "names", "roles", "statistics", "scaler", "transforms"]
    )
    def test_with_another_type_of_field_end_in_one_line(self, folder, field, value):
        self.forge(folder, lambda record: record.__setitem__(field, value))
        with contextlib.suppress(OffbeatError):
            load_model(folder)

    @pytest.mark.parametrize(
        "sizes",
        [{"hidden_size": 10**9}, {"hidden_size": 10**5}, {"decoder_units": [10**9]},
         {"decoder_units": [50_000, 50_000]}],
    )  # fmt: skip
    def test_of_sizes_that_no_file_holds_allocate_nothing(self, folder, sizes, capsys):
        self.forge(folder, lambda record: record["model"].update(sizes))
        self.refused(folder, "its config asks for layers of", capsys)

    def test_with_a_header_of_any_length_are_refused(self, folder, capsys):
        self.forge(folder, tensors=(2**60).to_bytes(8, "little") + b"{}")
        self.refused(folder, "although its checksum matches", capsys)

    def test_that_are_whole_are_read(self, folder):
        self.forge(folder)
        assert torch.isfinite(next(load_model(folder).parameters())).all()


@pytest.mark.parametrize("closed", ["<&-", ">&-"])
def test_a_stream_without_input_or_output_ends_in_one_line(closed, tmp_path):
    folder = fuzz.make_checkpoint(tmp_path)
    done = subprocess.run(
        ["bash", "-c", f"exec {sys.executable} -m offbeat stream {folder} {closed}"],
        capture_output=True,
        text=True,
        input="",
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == (
        "offbeat: error: standard input and standard output must be open; a stream reads and "
        "answers\n"
    )


def test_a_closed_error_output_and_a_full_disk_end_as_they_should(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("time,x,y\n" + tables.BODY)
    monkeypatch.setattr(sys, "stderr", None)
    small = ["--model.name=gru", "--model.hidden_size=2", "--training.epochs=1"]
    assert main(["train", "log.csv", "run", *small]) == 0
    sys.stderr.close()
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        monkeypatch.setattr(full, "write", lambda text: os.write(full.fileno(), text.encode()))
        assert main(["inspect", "log.csv"]) == 2
        monkeypatch.undo()
    why = "No space left on device; free some space, then repeat the command"
    assert capsys.readouterr().err == f"offbeat: error: the output can't be written: {why}\n"


@pytest.mark.parametrize("seen", [10**400, "x", [], {}, True, 1e400])
def test_a_state_with_anything_for_a_number_changes_nothing(seen, tmp_path):
    record = json.loads(fuzz.make_state(tmp_path).read_text())
    stream = fuzz.Stream(fuzz.model())
    before = stream.state()
    with pytest.raises(InputError):
        stream.restore({**record, "seen": seen})
    assert stream.state() == before


def test_the_page_of_security_names_files_that_are_there():
    root = Path(__file__).parent.parent
    text = (root / "SECURITY.md").read_text()
    for name in re.findall(r"`([\w/]+\.py)", text):
        places = (root / "src" / "offbeat" / name, root / "tests" / name,
                  root / "src" / "offbeat" / "data" / name, root / name)  # fmt: skip
        assert any(place.is_file() for place in places), name
