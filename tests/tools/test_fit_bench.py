"""``bench.py fit``: errors against the truth, and tables that say what is reached and what is missed."""

import json
import math

import numpy as np
import pytest
import torch
import yaml
from bench.cases import fit as case
from bench.cases import fit_bias
from bench.problems.films import write_video

from gaussian_swaying.fitting.variants import states_of
from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, measure, shown

ROW = {
    "speed_error": 0.004,
    "direction_error_deg": 0.5,
    "material.E_error": -0.008,
    "psnr_predicted_db": 31.26,
    "seconds": 12.4,
    "points": 1200,
    "size": [200, 120],
    "until_s": 0.75,
}


def test_errors_of_a_flow():
    found = case.errors([0.0, 2.2, 0.0], [2.0, 0.0, 0.0])
    assert found["speed_error"] == pytest.approx(0.1)
    assert found["direction_error_deg"] == pytest.approx(90.0)


def test_the_settings_of_own_data_are_a_simulation(tmp_path):
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(case._settings(case.SIZES["cpu"])))
    simulation = Simulation.from_yaml(tmp_path / "base.yaml", device="cpu")
    assert set(simulation.painter.cameras) == {"left", "right"}
    assert simulation.wind.flows[0].tolist() == case.TRUTH["flow"]


def test_missed_goals_and_what_was_not_found_are_told():
    lost, wild = ROW | {"psnr_rest_db": 40.0, "psnr_fitted_db": 30.0}, ROW | {"speed_error": 0.07}
    rows = {"two cameras": ROW, "one camera": ROW | {"speed_error": -0.02}, "pixels alone": ROW | {"speed_error": 0.9}}
    rows |= {"x": lost, "y": ROW | {"not_settled": "The values have not settled."}}
    found = cells("fit.own", [HEAD | {"own": rows}])
    assert found[0] == ["two cameras", "+0.40 %", "0.50°", "-0.80 %", "31.3 dB", "12 s", "yes"]
    assert [(row[0], row[-1]) for row in found[1:]] == [
        ("one camera", "no"), ("pixels alone", ""), ("x (not followed)", "yes"), ("y (not settled)", "yes"),
    ]  # fmt: skip
    rows = {"flag, two cameras": wild | {"known": {"solver.dx": 0.06}, "cells": 50}, "flag, one camera": wild}
    rows["curtain, two cameras"] = {"refused": "The video cannot tell."}
    found = {row[0]: row[-2:] for row in cells("fit.blender", [HEAD | {"blender": rows}])}
    assert found["flag, two cameras"] == ["0.75 s; 50 cells; `solver.dx` 0.06", "no"]
    assert found["flag, one camera"][1] == "yes"
    assert found["curtain, two cameras"][1] == "no"
    for slot in ("fit.blender", "fit.bias", "fit.reference", "fit.soft", "fit.soft_motion"):
        assert shown(slot, [HEAD]) == []


def test_a_claim_about_all_cases_counts_them():
    """Ablations have no goal, and sharp frames are a goal of their own."""
    wrong, dull = ROW | {"direction_error_deg": 4.0}, ROW | {"psnr_predicted_db": 25.0}
    rows = {"a, two cameras": ROW, "b, two cameras": wrong, "b, one camera": wrong, "c, one camera": dull}
    rows |= {"a, tracks alone": wrong, "d, one camera": {"refused": "x"}}
    result = HEAD | {"blender": rows}
    assert shown("fit.within", result) == "3 of 5"
    assert shown("fit.sharp", result) == "3 of 5"


def test_rows_of_a_case_of_blender():
    truth = {"flow": [3.0, -4.0, 0.0], "speed": 5.0, "C_D": 1.0}
    rows = case.blender_rows({"aero.law": "linear", "solver.dx": 0.1}, truth)
    assert rows["tracks alone"] == {"stages": ["tracks"]}
    assert rows["without patches"]["known"] == {
        "aero.law": "projected",
        "solver.dx": 0.1,
        "aero.C_D": pytest.approx(0.8),
        "aero.C_F": pytest.approx(0.8),
    }


def test_predicted_frames_are_compared_with_what_the_splat_reaches_at_rest():
    rows = {
        f"flag {k}, two cameras": ROW | {"psnr_predicted_db": p, "psnr_rest_db": r, "known": {}}
        for k, (p, r) in enumerate([(28.5, 30.0), (27.0, 30.0), (26.5, 26.0)])
    }
    rows["flag 3, tracks alone"] = ROW | {"psnr_rest_db": 30.0}
    found = cells("fit.blender", [HEAD | {"blender": rows}])
    assert [row[7] for row in found] == ["yes", "no", "yes", "yes"]
    assert found[3][-1] == ""


def test_faults_of_the_model_are_shown_with_the_grid_that_has_them():
    row = dict.fromkeys(("speed_error", "azimuth_error_deg", "material.E_error"), 0.0063) | {"points": 1800}
    name = fit_bias.name_of("flag", {"solver.dx": 0.01, "solver.boundaries": [{}]}, 1.0)
    assert name == "flag, solver.dx 0.01, solver.boundaries, to 1 s"
    assert fit_bias.name_of("flag", {}, None, "same.npz") == "flag, beside same.npz"
    rows = {name: row | {"rms_px": 2.166}, "flag, solver.dx 0.01": row | {"rms_px": 320.0}}
    assert cells("fit.bias", [HEAD | {"bias": rows}]) == [
        ["flag, `dx 0.01`, `boundaries`, `to 1 s`", "2.17 pixels", "+0.63 %", "+0.01°", "+0.63 %", "1,800"],
        ["flag, `dx 0.01`", "the simulation diverged", "", "", "", "1,800"],
    ]


def test_a_bias_is_the_step_that_undoes_the_difference(tmp_path):
    """The true motion is that of the base in another wind and of another stiffness: the step leads there."""
    folder, simulation, truth = _case(tmp_path)
    other = {"wind.speed": 5.05, "wind.azimuth": truth["azimuth"] + 0.5, "material.E": 9.9e3}
    _write_cloth(folder / "cloth.npz", simulation, other)
    row = fit_bias.bias(folder, {}, 4 / 24, "cpu")
    assert row["speed_error"] == pytest.approx(0.01, abs=0.001)
    assert row["azimuth_error_deg"] == pytest.approx(0.5, abs=0.05)
    assert row["material.E_error"] == pytest.approx(-0.01, abs=0.001)
    assert 0 < row["rms_px"] < 1
    changed = fit_bias.bias(folder, {"solver.gravity": [0.0, 0.0, -5.0]}, 4 / 24, "cpu")
    assert changed["rms_px"] > row["rms_px"]
    _write_cloth(folder / "same.npz", simulation, {})
    same = fit_bias.bias(folder, {}, 4 / 24, "cpu", "same.npz")
    assert same["azimuth_error_deg"] == pytest.approx(0.0, abs=0.01)


def test_a_splat_that_moves_as_the_reference_shows_the_video(tmp_path):
    """The video is that of the base: beside its own motion, that of another wind looks less like it."""
    folder, simulation, truth = _case(tmp_path)
    _write_cloth(folder / "cloth.npz", simulation, {})
    (folder / "uncertainty").mkdir()
    _write_cloth(folder / "uncertainty/coarser.npz", simulation, {"wind.azimuth": truth["azimuth"] + 15})
    given = ("fit", "--data", folder.parent, "--reference", "--law", "paper")
    result, saved = measure(*given)
    assert list(result["reference"]) == [
        "flag, cloth",
        "flag, uncertainty/coarser",
        "flag, simulated as in `scene.yaml`",
    ]
    assert [len(now["reference"]) for now in saved[1:4]] == [1, 2, 3]
    own, coarser, simulated = result["reference"].values()
    assert own["psnr_predicted_db"] > 35
    assert simulated["psnr_predicted_db"] > own["psnr_predicted_db"]
    assert coarser["psnr_predicted_db"] < own["psnr_predicted_db"] - 3
    measure(*given, "--known", '{"solver.dx": 0.12}', result=result)
    assert list(result["reference"])[3:] == ["flag, simulated `dx` 0.12"]
    (told,) = cells("fit.reference", [HEAD | {"reference": {"flag, cloth": own, "flag, uncertainty/coarser": coarser}}])
    assert told == ["flag", *(f"{row['psnr_predicted_db']:.1f} dB" for row in (own, coarser))]


def _case(tmp_path):
    """A folder as of make_fit_data.py, without the motion; its simulation and its truth."""
    folder = tmp_path / "flag"
    folder.mkdir()
    size = case.SIZES["cpu"] | {"frames": 5}
    settings = case._settings(size) | {"wind": {"flow": [4.0, 3.0, 0.0]}}
    (folder / "scene.yaml").write_text(yaml.safe_dump(settings))
    simulation = Simulation.from_yaml(folder / "scene.yaml", device="cpu")
    painter = simulation.painter
    write_video(simulation, folder, {name: painter.camera_at(0, name) for name in painter.cameras}, size["frames"], 0.0)
    unknowns = {"wind.speed": [3, 8], "wind.azimuth": [0, 60], "material.E": [5e3, 2e4]}
    (folder / "fit.yaml").write_text(yaml.safe_dump({"unknowns": {k: {"range": r} for k, r in unknowns.items()}}))
    truth = {"speed": 5.0, "azimuth": math.degrees(math.atan2(3, 4)), "E": 1e4, "fit_until": 2 / 24}
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder, simulation, truth


def _write_cloth(path, simulation, values):
    """The motion of five frames of a simulation with other values, as cloth whose vertices are the Gaussians."""
    times = [k / 24 for k in range(5)]
    scene = simulation.scene
    rest = scene.model.means.detach()[scene.moving]
    states = states_of(simulation, [values], times)
    shapes = [rest + scene.frame.displacement_to_scene(scene.follow.motion(own)[0]) for (own,) in states]
    x, z = (rest[:, k].double().round(decimals=4) for k in (0, 2))
    columns, rows = x.unique(), z.unique()
    order = (torch.searchsorted(columns, x) * len(rows) + torch.searchsorted(rows, z)).argsort()
    width, height = 0.4, 0.3
    np.savez(
        path,
        positions=torch.stack(shapes)[:, order].numpy(),
        faces=np.zeros((1, 4), np.int32),
        uv=torch.stack([x / width, z / height], -1)[order].numpy(),
        columns=len(columns) - 1,
        rows=len(rows) - 1,
        settings=json.dumps({"width": width, "height": height}),
    )
