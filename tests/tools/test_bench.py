"""The accuracy and the sweep of settings are measured, recorded and told."""

import json
import math
from pathlib import Path

import pytest
import torch
from bench.cases import pareto
from bench.cases.runs import comparison
from bench.tables.accuracy_goals import GOALS, judge
from bench.tables.rows import order, own_order

from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, shown

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def test_every_recorded_problem_has_a_goal_in_every_variant():
    """Also where it would be missed."""
    rows = [row for path in RESULTS.glob("accuracy_*.json") for row in json.loads(path.read_text())["rows"]]
    kinds: dict[tuple, list] = {}
    for row in rows:
        kind = [row["parameters"].get(name) for name in ("variant", "ends", "clamp", "hold", "area")]
        kinds.setdefault((row["problem"], *kind), []).append(row)
    assert len(kinds) > 35
    for kind, own in kinds.items():
        assert any(judge(goal, own) for goal in GOALS), kind
    assert all(goal.more["why"] and goal.more["wanted"] for goal in GOALS)


def test_goals_that_are_missed_are_in_bold_beside_those_that_are_reached():
    def bar(variant, cells, error):
        parameters = {"variant": variant, "cells": cells, "clamp": "mirror"}
        return {"problem": "hanging bar", "parameters": parameters, "result": {"error": error}}

    rows = [bar("total", 16, 4e-4), bar("total", 32, 1e-4), bar("updated", 16, 1e-4), bar("updated", 32, 2e-4)]
    plate = {"problem": "hinged plate", "parameters": {"variant": "total", "law": "paper", "k": 1}}
    rows += [plate | {"result": {"error": error, "angle": 1.0, "exact": 1.0}} for error in (0.1, -1.5)]
    found = {name: told for name, *told in cells("accuracy.goals", [{"rows": rows}])}
    told = found["bar hanging under its own weight, observed order in dx"]
    assert told[2:] == ["`total` 2.00, `updated` **-1.00**", "**no**"]
    assert found["hinged plate, both laws"][2:] == ["`total` **1.50 degrees at worst**", "**no**"]


@pytest.mark.parametrize("problem", ["bar", "cantilever", "hinged plate", "flag"])
def test_the_sweep_covers_what_it_should(problem):
    """Four sizes, CFL 0.1 to 0.8, both precisions, three formulations, the default, and a fixed substep."""
    rows = [row for row, _ in pareto.settings_of(problem, "cpu")]
    assert len({row["size"] for row in rows}) == 4
    assert {row["cfl"] for row in rows} >= {0.1, 0.2, 0.4, 0.8}
    assert {row["dtype"] for row in rows} == {"float32", "float64"}
    assert {row["variant"] for row in rows} == {"total", "updated", "MLS"}
    assert sum(pareto.is_default(row) for row in rows) == 4
    assert problem == "cantilever" or any(row["substep"] for row in rows)


def test_the_default_is_that_of_the_solver():
    """The star of the plots is what a user gets who sets nothing."""
    solver = MPMSolver()
    default = pareto.DEFAULT
    assert (solver.formulation, solver.cfl, solver.substep) == (default["variant"], default["cfl"], default["substep"])
    assert solver.mls is False
    parser = Simulation.parser()
    assert parser.get_default("dtype") == default["dtype"]


def test_the_front():
    def row(error, wall):
        return {"error": error, "wall_per_simulated_s": wall}

    rows = [row(1.0, 1.0), row(0.5, 2.0), row(0.6, 3.0), row(0.1, 8.0), row(None, 0.1), row(0.1, 7.8)]
    assert pareto.front(rows) == [rows[0], rows[1], rows[5]]
    good = [pareto.on_front(r, rows) for r in rows if r["error"]]
    # the dearer of two equals is within the noise of the clock
    assert good == [True, True, False, True, True]


def test_claims_of_the_pages_are_those_of_the_records():
    """Substeps are counted, as times depend on what else ran; a run takes its whole process."""
    flag = {"problem": "flag", "size": 0.08, "wall_per_simulated_s": 9.0} | pareto.DEFAULT
    rows = [flag | {"error": 0.02, "substeps": 300.0}]
    rows.append(flag | {"cfl": None, "substep": 1e-4, "error": 0.021, "substeps": 6000.0})
    assert shown("pareto.adaptive", {"rows": rows})[2] == "| 0.08 | 300 | 6,000 | 20.0 | 0.0200 | 0.0210 | 0.00100 |"
    runs = [{"name": "flag", "process_wall_s": 1.0, "simulated_s": 3.0}]
    runs.append({"name": "guitar, 1920x1080", "process_wall_s": 8.57, "simulated_s": 9.96})
    assert shown("runs.seconds", {"runs": runs}, "guitar") == "8.6 s for 10 simulated seconds"


@pytest.mark.parametrize("p", [1.0, 2.0, 3.3])
def test_the_order_toward_an_own_limit(p):
    rows = [{"parameters": {"cells": n}, "result": {"ratio": 1.7 - 0.3 * n**-p}} for n in (3, 4, 6)]
    assert own_order(rows) == pytest.approx(p, abs=1e-6)
    rows[2]["result"]["ratio"] = 0.0  # turns back
    assert math.isnan(own_order(rows))
    rows[2]["result"]["ratio"] = rows[1]["result"]["ratio"] + 1.0  # grows
    assert math.isnan(own_order(rows))


def test_the_observed_order():
    coarse, fine = ({"parameters": {"cells": n}, "result": {"error": 3.0 / n**2}} for n in (8, 12))
    assert order(coarse, fine) == pytest.approx(2.0)
    assert math.isfinite(order(coarse, fine))


def test_what_a_longer_substep_costs():
    """The median over pairs that are alike but for the CFL number; fixed substeps and float64 do not count."""

    def row(size, cfl, wall, **more):
        base = {"problem": "bar", "size": size, "variant": "total", "dtype": "float32", "cfl": cfl, "substep": None}
        return base | {"error": 0.1, "wall_per_simulated_s": wall} | more

    rows = [row(1, 0.4, 1.0), row(1, 0.8, 0.5), row(2, 0.4, 2.0), row(2, 0.8, 1.2), row(3, 0.4, 4.0), row(3, 0.8, 2.8)]
    rows += [row(4, 0.4, 1.0), row(1, 0.8, 9.0, dtype="float64"), row(2, 0.8, 9.0, substep=1e-3)]
    rows += [row(5, 0.4, 1.0), row(5, 0.8, 9.0, error=None)]
    assert shown("pareto.time_at", {"rows": rows}, "0.8") == "0.60"


def test_the_time_of_a_comparison():
    """A short one, and what the page says of it."""
    found = comparison(torch.device("cpu"), 2)
    assert (found["frames"], found["points"], found["picture"]) == (2, 10_000, [480, 270])
    assert found["particles"] > 10_000
    for frames, reached in ((2, []), (250, ["yes"])):
        result = HEAD | {"runs": [], "comparison": found | {"frames": frames, "process_wall_s": 29.0}}
        goals = [goal for goal in cells("goals.table", [result]) if "compared with a reference" in goal[0]]
        assert [goal[2] for goal in goals] == reached
    told = shown("runs.whole", result)[-1]
    assert "250 frames" in told
    assert "480 x 270 pixels against a surface of 10,000 points in 29.0 s" in told
