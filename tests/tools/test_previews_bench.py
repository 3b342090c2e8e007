"""``bench.py previews`` compares what was announced with what a run took."""

import json
from pathlib import Path

import pytest
import yaml
from bench.cases import previews

ROOT = Path(__file__).resolve().parents[2]
SMALL = {
    "scene": {"generator": {"init_args": {"spacing": 0.05}}},
    "solver": {"dx": 0.1},
    "camera": {"init_args": {"width": 64, "height": 36}},
}


def test_announced_and_taken_times_stand_side_by_side(tmp_path):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(SMALL))
    files = ["--config", str(ROOT / "configs/sim/flag2.yaml"), "--config", str(tmp_path / "small.yaml")]
    row = previews.announced_and_taken("flag2", files, files, "cpu", 3)
    found = row["run"]
    assert found["frames"] == 3
    assert found["ratio"] == pytest.approx(found["announced_s"] / found["process_s"])
    assert 0 < found["announced_s"] < 60  # of three frames, not of all
    # the preview times two to nine of the first frames, as fast as the machine is: 12 substeps each, 14.7 over nine
    assert found["substeps"] <= found["announced_substeps"] <= 1.25 * found["substeps"]
    assert "nothing.yaml" in previews.announced_and_taken("x", ["--config", "nothing.yaml"], files, "cpu")["failed"]


def test_an_unknown_scene_is_refused_and_none_is_no_work(bench, tmp_path):
    with pytest.raises(SystemExit, match="not bush"):
        bench("previews", "--device", "cpu", "--results", tmp_path, "--scenes", "bush")
    bench("previews", "--device", "cpu", "--results", tmp_path, "--scenes", "")
    assert not list(tmp_path.glob("*.json")) or json.loads((tmp_path / "previews_cpu.json").read_text())["seed"] == 0
