"""Flags on finer and finer grids: what is solved and compared, and what is shown of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bench.cases import refinement
from bench.cases.blender import Run
from bench.cases.refinement import RIPPLE, Rippled
from bench.tables.refinement import plot

from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, measure


@pytest.fixture
def solved(monkeypatch):
    """No solver: the rest shape, which moves away the more, the coarser it is; and what was solved."""
    asked = []

    def solve(run, python):
        asked.append((type(run).__name__, run.pattern, run.solver, run.cells))
        mesh = replace(run, solver="blender")
        flag = mesh.flag()
        moved = np.repeat(flag.rest(flag.grid().uv())[0][None].astype(np.float32), run.frames, axis=0)
        moved[1:, :, 1] += (0.1 if run.solver == "blender" else 0.2 if run.cells == 24 else 0.3) / run.cells
        if run.solver == "ours":
            axes = [(np.arange(count) + 0.5) / count for count in (9, 24)]
            moved = mesh.cloth(moved).sample(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2))
        return moved, {"points": 7, "steps": 5, "seconds": 2.0, "process_s": 3.0}

    monkeypatch.setattr(Run, "solve", solve)
    monkeypatch.setattr(refinement, "version", lambda python: "4.5")
    return asked


def test_a_rippled_flag_is_rippled_on_both_sides():
    parser = Simulation.parser()
    run = Rippled("pennant", "ours", 20, 3)
    settings = parser.parse_args([*run.arguments(), "--device=cpu"])
    assert settings.scene.generator.init_args.ripple == RIPPLE == run.flag().ripple
    flat = parser.parse_args([*Run("pennant", "ours", 20, 3).arguments(), "--device=cpu"])
    assert flat.scene.generator.init_args.ripple == 0
    assert flat.aero.law == "linear"
    assert flat.solver.dx == pytest.approx(1.6 / 20)
    size = flat.scene.generator.init_args
    assert (size.width, size.height) == (run.flag().width, run.flag().height)
    stiffness = flat.material.E * flat.material.thickness
    assert stiffness == pytest.approx(run.flag().youngs_modulus * run.flag().thickness)


def test_each_grid_is_compared_with_the_finest_mesh(solved, tmp_path):
    small = ["--flags", "pennant", "--grids", "8,24", "--blender_cells", "16,32", "--frames", "4"]
    result, _ = measure("refinement", *small, "--references", tmp_path, result=json.loads(json.dumps(HEAD)))
    both = [(kind, "pennant", "blender", n) for kind in ("Run", "Rippled") for n in (32, 16)]
    ours = [(kind, "pennant", "ours", n) for kind in ("Run", "Rippled") for n in (8, 24)]
    assert solved == [*both[:2], *ours[:2], *both[2:], *ours[2:]]
    rows = {row["cells"]: row for row in result["rows"]}
    for number, step in ((8, 0.3), (24, 0.2)):
        expected = 0.75 * (step / number - 0.1 / 32) / 1.6
        assert rows[number]["same_places"] == pytest.approx(expected, rel=1e-3)
    itself = result["references"]["pennant"]["chamfer"]
    assert result["references"]["pennant"]["same_places"] == pytest.approx(0.75 * 0.1 / 32 / 1.6, rel=1e-3)
    assert result["uneven"]["24"]["to_flat"]["first"] > 1e-3 > result["uneven"]["24"]["first"]
    (line,) = cells("refinement.rows", result)
    assert line[0] == "pennant"
    assert line[1:3] == [f"{100 * rows[n]['chamfer']:.2f} %" for n in (8, 24)]
    growing, last = cells("refinement.goals", result)
    assert growing[-1] == last[-1] == "yes"
    rows[24]["chamfer"] = rows[8]["chamfer"] + 1.1 * itself  # a finer grid that is worse
    assert cells("refinement.goals", result)[0][-1] == "no"
    assert [line[0] for line in cells("refinement.uneven", result)] == [
        "Blender's finer mesh",
        "ours, 8 cells",
        "ours, 24 cells",
    ]
    plot([result], tmp_path)
    assert (tmp_path / "refinement.png").stat().st_size > 10_000


def test_one_layer_is_recorded_beside_three(solved, tmp_path):
    parser = Simulation.parser()
    run = parser.parse_args([*refinement.OneLayer("pennant", "ours", 20, 3).arguments(), "--device=cpu"])
    assert (run.scene.layers, run.material.bending) == (1, "plate")
    small = ["--flags", "pennant", "--grids", "8", "--blender_cells", "16,32", "--frames", "4"]
    small += ["--references", tmp_path]
    three, _ = measure("refinement", *small, result=json.loads(json.dumps(HEAD)))
    solved.clear()
    both, _ = measure("refinement", *small, "--layers", "1", result=three)
    assert ("OneLayer", "pennant", "ours", 8) in solved
    assert [row["cells"] for row in both["rows"]] == [8]
    (line,) = cells("refinement.one_layer", both)
    assert line[:3] == ["pennant", "8", "7"]
    assert line[3] == line[5]


def test_contact_is_on_both_sides_and_recorded_beside_none(solved, tmp_path):
    ours, blender = (refinement.Touching("pennant", solver, 32, 3) for solver in ("ours", "blender"))
    run = Simulation.parser().parse_args([*ours.arguments(), "--device=cpu"])
    assert (run.contact.thickness, run.contact.friction) == (refinement.DISTANCE, 0)
    assert (blender.flag().self_collision, blender.flag().self_distance) == (True, refinement.DISTANCE)
    small = ["--flags", "pennant", "--grids", "8", "--blender_cells", "16,32", "--frames", "4"]
    small += ["--references", tmp_path]
    free, _ = measure("refinement", *small, result=json.loads(json.dumps(HEAD)))
    solved.clear()
    both, _ = measure("refinement", *small, "--contact", result=free)
    assert solved == [("Touching", "pennant", *rest) for rest in (("blender", 32), ("blender", 16), ("ours", 8))]
    (line,) = cells("refinement.touching", both)
    assert line[:2] == ["pennant", "8"]
    assert line[2] == line[3]
    assert float(line[5].split()[0]) == 0


def test_one_layer_and_three_take_turns(solved, tmp_path):
    small = ["--flags", "pennant", "--grids", "8", "--frames", "4", "--rounds", "2", "--references", tmp_path]
    result, _ = measure("refinement", *small, result=json.loads(json.dumps(HEAD)) | {"rows": [], "references": {}})
    assert [kind for kind, *_ in solved] == ["Run", "OneLayer"] * 3
    assert cells("refinement.turns", result) == [["pennant", "8", "2.0", "2.0", "1.00"]]
