"""``bench.py surfaces``: what it measures of a splat, how it trains, and what it shows."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bench.cases import surfaces, trained

from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat
from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import HEAD, cells, measure, shown


@pytest.fixture
def cloth(tmp_path):
    """The rest shape of a flat flag as the data set stores it."""
    x, z = np.meshgrid(np.linspace(0, 1.2, 61), np.linspace(0, 0.8, 41), indexing="ij")
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], -1)
    normals = np.tile([0.0, -1.0, 0.0], (x.size, 1))
    path = tmp_path / "cloth.npz"
    np.savez(path, positions=vertices[None].astype(np.float32), rest_normals=normals)
    return path


def test_axes_that_are_turned_and_centres_that_are_not(cloth, tmp_path):
    """All axes turned by half a degree: so are patches, not planes through neighbours. A stray Gaussian is left out."""
    cloud = FlagScene(spacing=0.02, ripple=0.0).generate()
    half = math.radians(0.25)
    turn = quat_to_rotation(torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)]))
    cloud = replace(cloud, quats=rotation_to_quat(turn @ quat_to_rotation(cloud.quats)))
    cloud.means[0, 1] += 0.3
    write_ply(tmp_path / "flag.ply", cloud)
    found = trained.tilts(tmp_path / "flag.ply", cloth)
    assert found["gaussians"] == len(cloud.means) - 1
    assert found["height_rms_mm"] < 1e-3
    for size in (10, 20, 40):
        assert found["smallest_axis"][f"tilt_{size}cm_deg"] == pytest.approx(0.5, abs=0.01)
        assert found["neighbours"][f"tilt_{size}cm_deg"] < 0.01
    assert found["smallest_axis"]["median_deg"] == pytest.approx(0.5, abs=0.01)


def test_what_cameras_allow(tmp_path):
    photos = GeneratedCapture(views=24, size=8).write(tmp_path / "photos")
    found = surfaces.limits(photos)
    assert found["all of the views"]["all_views"] > 3 * found["a quarter of the views"]["all_views"]
    assert 0 < found["all of the views"]["tilt_deg"] < found["a quarter of the views"]["tilt_deg"]


def test_terms_begin_half_way_through():
    command = trained.train_command(Path("photos"), surfaces.WAYS["views"][1], 7000, Path("out"), seed=1)
    assert "--model.loss_terms.photometric.init_args.start=3500" in command
    assert "--data.init_args.seed=1" in command
    plain = trained.train_command(Path("p"), surfaces.WAYS["paper"][1], 10, Path("o"))
    assert not any("loss_terms" in part or "seed" in part for part in plain)


def _row(psnr, seconds):
    tilt = {"tilt_10cm_deg": 0.6, "tilt_20cm_deg": 0.4, "tilt_40cm_deg": 0.3, "median_deg": 1.0}
    row = {"tilt": {"smallest_axis": tilt, "neighbours": tilt | {"tilt_40cm_deg": 0.08}, "height_rms_mm": 0.4}}
    return row | {"chamfer": {"smallest_axis": 0.03, "neighbours": 0.015}, "psnr_db": psnr, "seconds": seconds}


def test_tables():
    rows = {"views": {"0": _row(34.1, 200.0), "1": _row(34.1, 200.0)}}
    result = HEAD | {"pattern": 2, "steps": 7000, "at_once": 4, "rows": rows}
    goals = [["tilt over 40 cm at most 0.1°", "0.08°, 0.08°", "yes"], ["1.50 %, 1.50 %", "yes"]]
    assert [goals[0], cells("surfaces.goals", result)[1][1:]] == [cells("surfaces.goals", result)[0], goals[1]]
    rows["views"]["1"]["chamfer"] = {"smallest_axis": 0.03, "neighbours": 0.021}
    rows["paper"] = {"0": _row(34.2, 100.0), "1": _row(34.5, 130.0)}
    found = [row[1:] for row in cells("surfaces.goals", result)]
    assert found[1:] == [["1.50 %, 2.10 %", "no"], ["0.10 dB, 0.40 dB", "no"], ["2.00 times, 1.54 times", "no"]]
    assert cells("surfaces.rows", result)[-1][2:6] == ["0.60, 0.60", "0.40, 0.40", "0.08, 0.08", "1.00, 1.00"]


def test_ways_are_compared_at_the_same_time(tmp_path, monkeypatch):
    """Splats that exist are not trained again; each is simulated with both kinds of normals; gentler losses count."""
    for way in ("paper", "gentle"):
        (tmp_path / f"{way}_0").mkdir()
        (tmp_path / f"{way}_0" / "point_cloud.ply").write_bytes(b"ply")
    monkeypatch.setattr(surfaces, "limits", lambda photos: {})
    monkeypatch.setattr(surfaces, "tilts", lambda splat, cloth: _row(1, 1)["tilt"])

    def run_row(pattern, variant, options, splat, output, pictures):
        assert not pictures
        return {"chamfer_share": 0.03 if options.more.endswith("smallest_axis") else 0.015}

    monkeypatch.setattr(surfaces, "run_row", run_row)
    words = ("--ways", "paper,gentle", "--seeds", 1, "--at_once", 2, "--splats", tmp_path, "--more=--frames=2")
    result, saved = measure("surfaces", "--dataset", tmp_path, *words, result=dict(HEAD))
    assert [len(now["rows"]) for now in saved[1:3]] == [1, 2]
    for way in ("paper", "gentle"):
        assert result["rows"][way]["0"]["chamfer"] == {"smallest_axis": 0.03, "neighbours": 0.015}
    result["rows"]["views"] = {"0": _row(30.0, 400.0)}
    assert "| 1.50 % | yes |" in shown("surfaces.goals", result)[-1]
