"""``bench.py winds`` and its tables."""

import json
from functools import partial

import pytest
from bench.cases import winds

from gaussian_swaying.mpm.state import GridSpec

from .conftest import cells, shown


def test_a_small_record_and_its_tables(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(winds, "BOX", (16, 8, 8))
    monkeypatch.setattr(winds, "STEPS", {"cpu": 2})
    monkeypatch.setattr(winds, "ROUNDS", {"cpu": 3})
    monkeypatch.setattr(winds, "MeshObstacle", partial(winds.MeshObstacle, cells=8))
    monkeypatch.setattr(winds, "CUBE", GridSpec(0.04, (0, 0, 0), (25, 25, 25)))
    monkeypatch.setattr("bench.pages.refill", lambda *_: None)
    bench("winds", "--device", "cpu", "--results", tmp_path, "--counts", "64", "--formulations", "total")
    found = json.loads((tmp_path / "winds_cpu.json").read_text())
    assert [row["wind"] for row in found["rows"]] == list(winds.KINDS)
    assert found["rows"][0]["ratio"] == 1.0
    assert all(row["ratio"] > 0 and row["path"] == "torch" for row in found["rows"])
    assert found["box"]["cells"] == [16, 8, 8]
    assert [row["obstacle"] for row in found["obstacles"]] == list(winds.OBSTACLES)
    assert len(shown("winds.obstacles", found)) == 4 + len(winds.OBSTACLES)
    assert len(shown("winds.rows", found)) == 4 + len(winds.KINDS)
    assert "at most 1.3 times" in shown("winds.goals", found)[2]
    bench(
        "winds",
        "--device",
        "cpu",
        "--results",
        tmp_path,
        "--counts",
        "64",
        "--formulations",
        "total",
        "--only",
        "obstacles",
    )
    again = json.loads((tmp_path / "winds_cpu.json").read_text())
    assert (again["rows"], again["box"]) == (found["rows"], found["box"])
    assert [row["obstacle"] for row in again["obstacles"]] == list(winds.OBSTACLES)
    assert again["obstacles"] != found["obstacles"]
    with pytest.raises(SystemExit, match="--only takes box, rows, obstacles, not walls"):
        bench("winds", "--results", tmp_path, "--only", "walls")


def test_a_missed_goal_says_no():
    row = {"particles": 100_000, "formulation": "total", "wind": "turbulence", "ratio": 1.2, "median_ms": 0.05}
    result = {"device": "NVIDIA H200", "rows": [row], "box": {"cells": [4, 4, 4], "isotropic_s": 0.1, "sheared_s": 0.3}}
    assert [row[-1] for row in cells("winds.goals", result)] == ["no", "yes", "no"]
