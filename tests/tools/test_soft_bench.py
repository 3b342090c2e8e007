"""``bench.py soft``: a motion at the true values beside that of the data, and its tables."""

import json
import math

import numpy as np
import pytest
import yaml

from gaussian_swaying.simulation.simulation import Simulation

from .conftest import HEAD, cells, measure

TRUTH = {"flow": [2.0, 1.0, 0.0], "E": 2e4, "fit_until": 0.1, "C_D": 1.0, "speed": math.sqrt(5)}


@pytest.fixture
def folder(tmp_path):
    """A folder as of the case, whose true motion is our own, except that it goes a tenth farther."""
    flag = {"width": 0.4, "height": 0.2, "spacing": 0.05, "ripple": 0.0}
    box = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.06, None, None]}}
    settings = {
        "frame_dt": 1 / 24,
        "scene": {"generator": {"class_path": "FlagScene", "init_args": flag}, "metres_per_unit": 1.0},
        "material": {"E": 2e4, "density": 25.0},
        "solver": {"dx": 0.1, "boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": box}}]},
        "wind": {"flow": TRUTH["flow"], "modulations": []},
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(settings))
    frames = Simulation.from_yaml(tmp_path / "scene.yaml", camera=None, device="cpu").frames(4)
    ours = np.stack([frame.gaussians.means.numpy() for frame in frames])
    np.savez(tmp_path / "gaussians.npz", positions=ours[0] + 1.1 * (ours - ours[0]))
    settings["material"]["E"], settings["wind"]["flow"] = 1e4, [5.0, 0.0, 0.0]  # wrong, as in the data
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(settings))
    (tmp_path / "fit.yaml").write_text(yaml.safe_dump({"unknowns": {"wind.speed": {"range": [1.0, 9.0]}}}))
    (tmp_path / "truth.json").write_text(json.dumps(TRUTH))
    (tmp_path / "uncertainty.json").write_text(json.dumps({"variants": {"4 cells": {"mean_m": 1e-3}}}))
    return tmp_path


def test_the_motion_at_the_true_values_is_compared(folder):
    result, saved = measure("soft", "--data", folder, "--row", "motion", "--search", 4)
    row = result["motion"]["as in `scene.yaml`"]
    assert row["swing"] == pytest.approx(1 / 1.1, rel=1e-4)
    assert row["deflection"] == pytest.approx(1 / 1.1, rel=1e-4)
    assert 0 < row["mean_m"] < row["largest_m"] < row["swing_m"]
    assert len(row["per_frame_m"]) == 4
    assert row["points"] > 0
    assert result["reference"] == {"4 cells": {"mean_m": 1e-3}}
    assert "fits" not in result
    assert saved


def test_the_tables_say_what_differs():
    row = {"mean_m": 0.0012, "largest_m": 0.0056, "swing": 1.021, "deflection": 0.985, "points": 1480}
    fit = {"speed_error": 0.02, "direction_error_deg": 0.4, "material.E_error": 0.03, "psnr_predicted_db": 27.0}
    fit |= {"psnr_rest_db": 28.5, "processor_s": 60.0}
    record = HEAD | {
        "motion": {"`solver.dx` 0.03": row},
        "reference": {"8 cells": row},
        "fits": {"two cameras": fit | {"seconds": 100.0, "until_s": 0.75, "known": {"solver.dx": 0.03}}},
    }
    told = ["1.20 mm", "5.6 mm", "+2.1 %", "-1.5 %"]
    found = cells("fit.soft_motion", [record])
    assert found == [["ours, `solver.dx` 0.03; 1,480 points", *told], ["Newton, 8 cells", *told]]
    (found,) = cells("fit.soft", [record])
    assert found[:6] == ["two cameras", "+2.00 %", "0.40°", "+3.00 %", "27.0 dB", "100 s"]
    assert found[6:] == ["60 s", "28.5 dB", "0.75 s; `solver.dx` 0.03"]
