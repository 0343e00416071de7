"""One training by several ranks: processes with gloo, compared with one process."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import offbeat as ob
from offbeat.cli.app import main
from offbeat.distributed import LostRankError, Ranks, group
from offbeat.kernels import cpu

MODELS = ("gru", "gru_d", "ode_rnn")
SCRIPT = Path(__file__).with_name("rank_script.py")


def started(ranks: int, *arguments: object) -> list[tuple[int, str]]:
    """Exit code and standard error of each rank of the script."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = []
    for rank in range(ranks):
        own = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": ranks, "MASTER_PORT": port}
        environment = {**os.environ, **{k: str(v) for k, v in own.items()}}
        environment |= {"MASTER_ADDR": "127.0.0.1", "OMP_NUM_THREADS": "1"}
        command = [sys.executable, str(SCRIPT), *map(str, arguments)]
        processes.append(
            subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        )
    said = [process.communicate(timeout=200)[1] for process in processes]
    return [(p.returncode, text) for p, text in zip(processes, said, strict=True)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Weights of one process after two epochs."""
    out = tmp_path_factory.mktemp("alone")
    [(code, said)] = started(1, out, 2, ",".join(MODELS))
    assert code == 0, said
    return {name: np.load(out / f"{name}-weights-0.npy") for name in MODELS}


def test_two_ranks_train_as_one_up_to_rounding_and_with_the_same_bits_as_each_other(
    alone, tmp_path
):
    for code, said in started(2, tmp_path, 2, ",".join(MODELS)):
        assert code == 0, said
        assert "threads of gloo: 0" in said
        if cpu.instruction_sets():  # two epochs of three steps, of all models but the redrawn one
            assert "steps without autograd: 12" in said
    for name, expected in alone.items():
        first, second = (np.load(tmp_path / f"{name}-weights-{rank}.npy") for rank in (0, 1))
        assert np.array_equal(first, second)
        assert np.allclose(first, expected, rtol=1e-4, atol=1e-6)


def test_a_lost_rank_ends_the_run_which_resumes_with_another_number_of_ranks(alone, tmp_path):
    (first, said), (last, _) = started(2, tmp_path, 2, "gru_d", 1)
    assert (first, last) == (3, 7), said
    assert "LostRankError: a rank was lost, as rank 0 of 2 sees it" in said
    assert "continues from the last checkpoint, with any number of ranks" in said
    assert "threads of gloo: 0" in said, "they may abort the process when it ends"
    [kept] = tmp_path.glob("gru_d/checkpoints/steps-*")
    assert kept.name == "steps-000000003"
    [(code, said)] = started(1, tmp_path, 2, "gru_d")
    assert code == 0, said
    resumed = np.load(tmp_path / "gru_d-weights-0.npy")
    assert np.allclose(resumed, alone["gru_d"], rtol=1e-4, atol=1e-6)


def test_parts_of_a_batch_are_disjoint_and_whole():
    index = torch.arange(7)
    for size in (1, 2, 3, 9):
        parts = [Ranks(rank, size).share(index) for rank in range(size)]
        assert torch.equal(torch.cat(parts), index)
        assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_without_torchrun_there_is_no_group(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with group() as ranks:
        assert ranks is None


def test_a_rank_without_others_says_what_is_wrong(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("RANK", "3")  # as some job systems set it
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert main(["predict", "nothing", str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]) == 2
    assert "nothing" in capsys.readouterr().err


def test_the_launch_of_ranks_that_is_not_complete_is_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ob.InputError, match="start them with torchrun, or unset it"), group():
        pass
    monkeypatch.setenv("WORLD_SIZE", "two")
    with pytest.raises(ob.InputError, match="start them with torchrun, or unset it"), group():
        pass
    monkeypatch.setenv("RANK", "1")
    assert main(["predict", "nothing", str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]) == 2
    assert capsys.readouterr().err == ""  # the first rank says it


@pytest.mark.parametrize(
    ("device", "message"),
    [("cuda", "torch finds no CUDA"), ("auto", "got 'auto'; give cpu or cuda")],
)
def test_a_device_that_ranks_do_not_have_is_one_line(monkeypatch, device, message):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for name, value in {"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "0"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ob.InputError, match=message), group(device):
        pass


def test_ranks_that_do_not_come_are_one_line(monkeypatch):
    with socket.socket() as taken:  # it listens to nobody
        taken.bind(("127.0.0.1", 0))
        own = {"WORLD_SIZE": "2", "RANK": "1", "MASTER_ADDR": "127.0.0.1"}
        for name, value in {**own, "MASTER_PORT": str(taken.getsockname()[1])}.items():
            monkeypatch.setenv(name, value)
        message = "rank 1 of 2 can't reach the others"
        with pytest.raises(LostRankError, match=message), group(timeout_s=1):
            pass
