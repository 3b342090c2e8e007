"""The pages are what the recorded JSON says, and the measurements run."""

import json
import math
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def _run(bench, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["bench.py", *map(str, arguments)])
    bench.main()


def test_the_pages_are_made_from_the_recorded_json(bench, monkeypatch, tmp_path):
    """No number in them is typed by hand: made again they are the same, and the plots are there."""
    shutil.copytree(ROOT / "docs/results", tmp_path / "docs/results")
    _run(bench, monkeypatch, "pages", "--results", tmp_path / "docs/results")
    for name in ("validation.md", "benchmarks.md"):
        assert (tmp_path / "docs" / name).read_text() == (ROOT / "docs" / name).read_text(), name
    text = (ROOT / "docs/validation.md").read_text()
    for picture in ("convergence.png", "pareto_cpu.png", "pareto_cuda.png"):
        assert f"(pictures/{picture})" in text
        assert (ROOT / "docs/pictures" / picture).exists()
        assert (tmp_path / "docs/pictures" / picture).stat().st_size > 10_000


def test_accuracy_replaces_only_what_it_was_asked_for(bench, monkeypatch, tmp_path):
    results = tmp_path / "docs/results"
    results.mkdir(parents=True)
    kept = {"problem": "vortex", "parameters": {"variant": "total", "cells": 8}, "result": {"error": 0.5}}
    (results / "accuracy_cpu.json").write_text(json.dumps({"rows": [kept]}))
    _run(bench, monkeypatch, "accuracy", "--device", "cpu", "--only", "sand element", "--results", results)
    found = json.loads((results / "accuracy_cpu.json").read_text())
    assert [row["problem"] for row in found["rows"]] == ["vortex", "sand element"]
    assert found["rows"][1]["result"]["triaxial_deg"] == pytest.approx(30.0, abs=0.1)
    assert found["versions"]["torch"]
    assert "30.0 in triaxial compression" in (tmp_path / "docs/validation.md").read_text()


def test_a_case_that_fails_is_recorded(bench, monkeypatch, tmp_path):
    def broken(**_):
        raise ValueError("no such sand")

    monkeypatch.setattr(bench.accuracy_cases, "_elements", broken)
    _run(bench, monkeypatch, "accuracy", "--device", "cpu", "--only", "sand element", "--results", tmp_path / "d/r")
    assert "failed: sand element" in (tmp_path / "d/validation.md").read_text()
    assert "no such sand" in (tmp_path / "d/validation.md").read_text()


def test_a_goal_that_is_missed_says_no(bench, tmp_path):
    rows = [
        {"problem": "hinged plate", "parameters": {"variant": "total", "law": "paper", "k": 1}, "result": result}
        for result in ({"error": 0.1, "angle": 1.0, "exact": 0.9}, {"error": -1.5, "angle": 1.0, "exact": 2.5})
    ]
    lines = bench.accuracy_cases.page([{"rows": rows, "device": "x", "versions": {}}], tmp_path)
    (goal,) = [line for line in lines if line.startswith("| hinged plate")]
    assert goal.endswith("| 1.50 degrees at worst | **no** |")


@pytest.mark.parametrize("problem", ["bar", "cantilever", "hinged plate", "flag"])
def test_the_sweep_covers_what_it_should(bench, problem):
    """Four sizes, CFL 0.1 to 0.8, both precisions, three formulations, the default, and a fixed substep."""
    rows = [row for row, _ in bench.pareto_cases.settings_of(problem, "cpu")]
    assert len({row["size"] for row in rows}) == 4
    assert {row["cfl"] for row in rows} >= {0.1, 0.2, 0.4, 0.8}
    assert {row["dtype"] for row in rows} == {"float32", "float64"}
    assert {row["variant"] for row in rows} == {"total", "updated", "MLS"}
    assert sum(bench.pareto_cases.is_default(row) for row in rows) == 4
    assert problem == "cantilever" or any(row["substep"] for row in rows)


def test_the_default_is_that_of_the_solver(bench):
    """The star of the plots is what a user gets who sets nothing."""
    solver = bench.MPMSolver()
    default = bench.pareto_cases.DEFAULT
    assert (solver.formulation, solver.cfl, solver.substep) == (default["variant"], default["cfl"], default["substep"])
    assert solver.mls is False
    parser = bench.build_parser()
    assert parser.get_default("dtype") == default["dtype"]


def test_the_front(bench):
    def row(error, wall):
        return {"error": error, "wall_per_simulated_s": wall}

    rows = [row(1.0, 1.0), row(0.5, 2.0), row(0.6, 3.0), row(0.1, 8.0), row(None, 0.1), row(0.1, 7.8)]
    assert bench.pareto_cases.front(rows) == [rows[0], rows[1], rows[5]]
    good = [bench.pareto_cases.on_front(r, rows) for r in rows if r["error"]]
    # the dearer of two equals is within the noise of the clock
    assert good == [True, True, False, True, True]


def test_the_observed_order(bench):
    coarse, fine = ({"parameters": {"cells": n}, "result": {"error": 3.0 / n**2}} for n in (8, 12))
    assert bench.accuracy_cases.order(coarse, fine) == pytest.approx(2.0)
    assert math.isfinite(bench.accuracy_cases.order(coarse, fine))
