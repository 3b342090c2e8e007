"""``bench.py sweeps``: its sweep files, its enlarged photos and its tables."""

import argparse
import json

import pytest
from bench.cases import sweeps
from PIL import Image

from gaussian_swaying.sweeps.plan import make_plan, read_sweep

from .conftest import HEAD, cells, shown


def test_the_small_flags_have_4096_points_each(tmp_path):
    axes = {"wind.seed": {"draw": "integer", "low": 0, "high": 9}}
    file = sweeps._sweep_file(tmp_path / "flags.yaml", sweeps._flag(0.8, 0.0125, 3), axes, 2)
    plan = make_plan(read_sweep(file))
    assert len(plan.runs) == 2
    assert "images: false" in plan.config


def test_a_sheet_of_more_gaussians_than_candidates_are_allowed(monkeypatch):
    """As one million at full size: each Gaussian reaches nearly a spacing, to where its neighbours are."""
    monkeypatch.setattr("gaussian_swaying.gaussians.subdivision._MOST", 4096)
    row = sweeps.one_sheet(argparse.Namespace(flags=1, device="cpu"), frames=6)
    assert row["particles"] == 4096
    assert row["per_s"] > 0


def test_photos_are_enlarged(tmp_path):
    (tmp_path / "small/images").mkdir(parents=True)
    Image.new("RGB", (6, 4), (200, 10, 10)).save(tmp_path / "small/images/a.png")
    known = {"fl_x": 5.0, "fl_y": 5.0, "cx": 3.0, "cy": 2.0, "w": 6, "h": 4, "k1": 0.1}
    known["frames"] = [{"file_path": name} for name in ("./images/a.png", "images/missing.png", "images/a")]
    (tmp_path / "small/transforms.json").write_text(json.dumps(known))
    made = sweeps.enlarged(tmp_path / "small", tmp_path / "large", 2)
    found = json.loads((made / "transforms.json").read_text())
    assert (found["fl_x"], found["cx"], found["w"], found["h"], found["k1"]) == (10.0, 6.0, 12, 8, 0.1)
    assert [frame["file_path"] for frame in found["frames"]] == ["./images/a.png", "images/a"]
    assert [path.name for path in (made / "images").iterdir()] == ["a.png"]
    with Image.open(made / "images/a.png") as image:
        assert image.size == (12, 8)


def _flags(wall, rate):
    return {"particles": 4096, "wall_s": wall, "frames_s": 30.0, "per_s": rate, "memory_bytes": 2**30}


def test_tables():
    ended = {"seconds": 9.5, "killed": 5, "complete": 40, "attempts": 45}
    workers = {"runs": 40, "workers": 2, "equal": True, "undisturbed": ended | {"killed": 0}, "disturbed": ended}
    cpu = HEAD | {"workers": workers}
    flags = {"1": _flags(100.0, 2.8e9), "2": _flags(52.0, 5.5e9)}
    sheet = {"particles": 1048576, "frames": 55, "frames_s": 2.0, "per_s": 3.0e9, "build_s": 9.0}
    trained = {"steps": 7000, "seconds": 80.0, "psnr_db": 29.0, "gaussians": 100}
    both = {"1": trained, "2": trained | {"steps": 3500, "seconds": 50.0, "psnr_db": 28.95}}
    gpu = HEAD | {"gpus": {"flags": 256, "frames": 1000, "rows": flags, "sheet": sheet}}
    gpu |= {"training": {"images": 7000, "rows": both}}
    goals = cells("sweeps.goals", [cpu, gpu])
    assert [row[2] for row in goals] == ["yes", "yes", "yes", "no", "yes"]
    assert "1.60 times" in goals[3][1]
    assert [row[1] for row in cells("sweeps.goals", [cpu])] == ["40 complete, 5 killed, tables equal", *["-"] * 4]
    assert shown("sweeps.gpus", [cpu]) == shown("sweeps.training", [cpu]) == []
    gpu["gpus"]["rows"] = {"1": {"failed": "no memory"}}
    assert "failed: no memory" in cells("sweeps.gpus", [gpu])[0]


@pytest.mark.slow(twin="test_killed_workers_change_nothing")
@pytest.mark.timeout(1800)
def test_a_disturbed_sweep(tmp_path):
    row = sweeps.disturbed_sweep(tmp_path, runs=8, kills=2)
    assert row["equal"]
    assert row["disturbed"]["killed"] == 2
