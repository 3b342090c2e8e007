"""``bench.py area`` records areas of bodies and of a captured splat, and its tables say what is reached."""

import argparse
import json

from bench.cases import area as case

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import cells, shown

BALLS = "open ball of leaves, leaf area index 1", "dense ball of leaves, leaf area index 4"


def test_areas_are_recorded_and_shown(tmp_path):
    write_ply(tmp_path / "flag.ply", FlagScene(spacing=0.1).generate())
    options = argparse.Namespace(
        results=str(tmp_path), body=["flag", "two shells, 0.2 m apart"], ply=[str(tmp_path / "flag.ply")], timed=500
    )
    case.run(options)
    record = json.loads((tmp_path / "area_cpu.json").read_text())
    assert record["bodies"]["flag"]["open"] > 0.99
    assert 0.9 < record["bodies"]["two shells, 0.2 m apart"]["open"] < 1.1
    assert record["timed"]["gaussians"] == 500
    lines = shown("area.bodies", record)
    assert any(line.startswith("| flag | 6,144 | 0.96 (as `coverage` finds) | 1.000 | 1.000 |") for line in lines)
    assert shown("area.capture", record, "flag", "hull") == "1.5"
    assert shown("area.capture", record, "flag", "open") == "1.0"


def test_missed_goals_are_said_to_be_missed():
    row = {"gaussians": 1e3, "area": 1.0, "coverage": 3.0, "known": True}
    names = ["sphere", "two shells", *("plate", "faint plate", "flag", "leafy branch", "crown of 300", *BALLS)]
    found = {name: row | {"open": 1.0} for name in names}
    found["two shells"] = row | {"open": 0.9}
    found["unresolved: haze"] = row | {"open": 1.04}
    found["crown of 300"] = row | {"open": 0.94}
    found[BALLS[1]] = row | {"open": 0.9}
    timed = {"gaussians": 150_000.0, "open_s": 2.5, "open_cpu_s": 2.4, "coverage_s": 4.0}
    result = {"bodies": found, "timed": timed, "device": "a CPU", "versions": {"torch": "2"}}
    found = cells("area.goals", result)
    assert [row[-1] for row in found] == ["no", "yes", "yes", "yes", "yes", "yes", "no", "yes", "no", "no"]
    assert "-10.0 % at worst (two shells)" in found[0][2]
