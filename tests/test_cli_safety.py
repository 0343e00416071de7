"""Configs come from other people: no option may run what a config names."""

from __future__ import annotations

import json

import pytest

from offbeat.cli.app import main


@pytest.mark.parametrize("command", ["inspect", "train", "evaluate", "predict", "impute"])
@pytest.mark.parametrize("nested", [False, True])
def test_a_config_cannot_run_a_command(command, nested, tmp_path, capsys):
    marker = tmp_path / "marker"
    hostile = {"class_path": "os.system", "init_args": {"command": f"touch {marker}"}}
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"reader": {"x": hostile} if nested else hostile}))
    paths = [str(tmp_path / name) for name in ("none", "none.csv", "out.csv")]
    paths = {"inspect": paths[1:2], "train": paths[1:], "evaluate": paths[:2]}.get(command, paths)
    assert main([command, *paths, "--config", str(config)]) == 2
    assert not marker.exists()
    assert len(capsys.readouterr().err.splitlines()) == 1
