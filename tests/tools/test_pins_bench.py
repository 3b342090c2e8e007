"""The comparison of pins: command lines that match the references, a row that is recorded, and its tables."""

import json
from dataclasses import replace

import pytest
from bench.cases import flags, pins

from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, measure, shown


@pytest.mark.parametrize("name", [name for name, pin in pins.ROWS.items() if pin.kind == "nodes"])
def test_rows_match_the_references(name, tmp_path):
    parser = Simulation.parser()
    for pattern, flag in flags.REFERENCES.items():
        arguments = flags.sim_arguments(pattern, pins.variant(pins.ROWS[name], pattern), tmp_path, None)
        settings = parser.parse_args(arguments)
        made, sheet = settings.scene.generator.init_args, settings.material
        assert settings.solver.dx == pins.grid_spacing(pins.ROWS[name], pattern)
        assert (settings.aero.law == "linear") == pins.ROWS[name].linear
        assert settings.scene.particle_spacing == pytest.approx(0.45 * settings.solver.dx)
        assert (made.width, made.height, made.yaw, made.ripple) == (flag.width, flag.height, flag.yaw, flag.ripple)
        assert sheet.E * sheet.thickness == pytest.approx(flag.material().membrane)
        assert sheet.density * sheet.thickness == pytest.approx(flag.material().areal_density)
        assert (settings.solver.damping, settings.frames) == (flag.damping, flag.frames)
        assert tuple(settings.wind.flow) == flag.flow
        pressure = 0.5 * settings.aero.air_density * settings.aero.C_D * sum(u * u for u in settings.wind.flow)
        assert pressure == pytest.approx(flag.pressure())
        (boundary,) = settings.solver.boundaries
        if flag.pinned == "top":  # less than 3 cm of the cloth, at its upper edge
            assert 0 < flag.height - boundary.init_args.region.init_args.min[2] < 0.03
        assert "kind" not in boundary.init_args or boundary.init_args.kind == "nodes"


def test_a_hinge_is_asked_for_by_its_name_and_holds_one_row_of_gaussians(tmp_path):
    parser = Simulation.parser()
    for pattern, flag in flags.REFERENCES.items():
        hinge, nodes = (pins.variant(pins.ROWS[name], pattern) for name in ("hinge_04", "nodes_04"))
        assert "--solver.boundaries.init_args.kind=hinge" in hinge.options
        assert not any("hinge" in option for option in nodes.options)
        without = tuple(option for option in hinge.options if ".kind=" not in option)
        settings = parser.parse_args(flags.sim_arguments(pattern, replace(hinge, options=without), tmp_path, None))
        box = settings.solver.boundaries[0].init_args.region.init_args
        spacing = settings.scene.generator.init_args.spacing
        if flag.pinned != "corners":
            held = box.max[0] if flag.pinned == "left" else flag.height - box.min[2]
            assert 0.5 * spacing < held < 1.5 * spacing


def test_rows_are_recorded_and_others_kept(tmp_path, monkeypatch):
    folder = tmp_path / "pattern5"
    folder.mkdir()
    (folder / "cloth.npz").write_bytes(b"")
    known = {"steps doubled": {"cells": 100, "quality": 256, "chamfer": 0.001, "chamfer_per_frame": [0.001]}}
    (folder / "uncertainty.json").write_text(json.dumps({"variants": known}))

    def row(pattern, variant, options, splat, output, pictures):
        assert (splat, pictures) == (None, False)
        return {"pattern": pattern, "title": variant.title, "chamfer_per_frame_m": [0.1]}

    monkeypatch.setattr(flags, "run_row", row)

    def of(rows="nodes", patterns="5", **more):
        return measure("pins", "--dataset", tmp_path, "--rows", rows, "--patterns", patterns, **more)

    result, saved = of("nodes_04,nodes", result={"rows": {"hinge": {"5": {}}}})
    assert [sorted(one["rows"]) for one in saved[1:3]] == [["hinge", "nodes_04"], ["hinge", "nodes", "nodes_04"]]
    assert result["rows"]["nodes_04"]["5"]["dx_m"] == 0.04
    assert result["rows"]["nodes"]["5"]["dx_m"] == 0.015
    assert result["uncertainty"] == {"5": {"steps doubled": {"cells": 100, "quality": 256, "chamfer": 0.001}}}
    for words, message in (
        ({"rows": "glue"}, r"--rows takes nodes, .* not glue"),
        ({"patterns": "4"}, r"has no pattern4/cloth.npz"),
        ({"patterns": "curtain"}, r"has no curtain/cloth.npz"),
        ({"patterns": "sail"}, r"--patterns takes 1, .*, curtain, light, pennant, not sail"),
    ):
        with pytest.raises(SystemExit, match=message):
            of(**words)


def _row(share, dx):
    return {
        "status": "complete", "chamfer_share": share, "torn_particles": 0, "particles": 1000, "ms_per_frame": 2.5,
        "dx_m": dx, "frames": 250,
    }  # fmt: skip


def test_the_page_compares_pins():
    rows = {
        "nodes": {"1": _row(0.0266, 0.015), "2": _row(0.0125, 0.015)},
        "hinge_04": {"1": _row(0.025, 0.04), "2": _row(0.013, 0.04), "4": _row(0.0149, 0.04), "5": {"failed": "x"}},
    }
    rows["hinge_04"]["light"] = _row(0.021, 0.04)
    known = {"cells": 100, "quality": 256, "frames_compared": 50, "chamfer": 0.0014}
    result = HEAD | {"rows": rows, "more": "--a=1", "note": "Quiet."}
    result["uncertainty"] = {"1": {"coarser": known}, "4": {"steps doubled": known}}
    (device,) = shown("pins.device", result)
    assert device == "a CPU; torch 2; seed 0.\nOther options of `tools/sim.py`: `--a=1`.\nQuiet."
    told = [row[1:] for row in cells("pins.rows", result)]
    assert told[1] == ["2.50 %", "1.30 %", "-", "1.49 %", "failed", "-", "2.10 %"]
    other = result | {"rows": {"nodes": {"2": rows["nodes"].pop("2")}}, "uncertainty": {"light": {"coarser": known}}}
    goals = {goal.partition(" on ")[0]: told for goal, *told in cells("pins.goals", [other, result])}
    nodes = "hinges at dx = 0.04 m no farther than held nodes"
    assert goals[f"pattern 1: {nodes}"] == ["2.50 %, 2.66 % at 0.015 m", "yes"]
    assert goals[f"pattern 2: {nodes}"] == ["1.30 %, 1.25 % at 0.015 m", "no"]
    assert goals[f"pattern 3: {nodes}"] == ["-", "-"]
    within = "hinges at dx = 0.04 m within 1.5 % of the longer side"
    assert goals[f"pattern 4 (curtain): {within}"] == ["1.49 % (reference itself: 0.14 %)", "yes"]
    assert goals[f"pattern 5 (light, stiff): {within}"] == ["-", "-"]
    within = within.replace("1.5 %", "2 %")  # of the longer side, for flags that nothing was tuned for
    assert goals[f"curtain: {within}"] == ["-", "-"]
    assert goals[f"light, stiff: {within}"] == ["2.10 % (reference itself: 0.14 %)", "no"]
    assert cells("pins.costs", result)[0][1:] == ["1,000; 2.5", *"------"]
    # the paper's flags are told with the flag benchmark
    assert shown("pins.reference", [result, other]) == [
        "- pattern 4: steps doubled (100 cells, 256 steps, 50 frames) 0.14 %",
        "- light: coarser (100 cells, 256 steps, 50 frames) 0.14 %",
    ]
