"""The frames of a recorded run as splats, against those of the simulation that made it."""

import json
import shutil
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from shared import peak, refused, seeded, up_to, user_warning, value_error

from gaussian_swaying.cli.export import main as export
from gaussian_swaying.gaussians.cloud import joined
from gaussian_swaying.gaussians.formats import FORMATS, export_cloud, read_gaussians
from gaussian_swaying.gaussians.ply import read_ply, write_ply
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import RecordedRun, Simulation

FRAMES = 4


def _box(low=(None,) * 3, high=(None,) * 3):
    return {"class_path": "Box", "init_args": {"min": list(low), "max": list(high)}}


@pytest.fixture(scope="module", params=["total", "modes", "updated"])
def recorded(request, tmp_path_factory):
    """A flag with y up, in units of 2 m, of which less than half moves and turns green; its simulation and its run."""
    place = tmp_path_factory.mktemp(request.param)
    flag = FlagScene(spacing=0.1).generate()
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    half = torch.tensor([0.5**0.5, -(0.5**0.5), 0.0, 0.0]).expand(len(flag), 4)  # z to y about x
    harmonics = 0.1 * torch.randn(len(flag), 3, 3, generator=seeded(1))
    sh = torch.cat([flag.sh[:, :1], harmonics], 1)
    quats = half * flag.quats[:, :1] if bool((flag.quats[:, 1:] == 0).all()) else half
    write_ply(place / "flag.ply", replace(flag, means=flag.means @ turn.T / 2, quats=quats, sh=sh, normals=None))
    settings = {
        "scene": {"ply": str(place / "flag.ply"), "up": [0, 1, 0], "metres_per_unit": 2.0},
        "material": {"E": 9e3, "nu": 0.3, "density": 30.0, "thickness": 0.01},
        "solver": {"formulation": request.param, "dx": 0.2},
        "wind": {"flow": [6.0, 3.0, 0.0]},
        "edits": [{"time": 0.06, "color": [0.0, 1.0, 0.0]}],
        "recorder": {"renders": []},
        "frames": FRAMES,
    }
    settings["scene"]["region"] = _box(low=(None, 0.31, None))
    pin = {"class_path": "PinnedRegion", "init_args": {"region": _box(high=(0.06, None, None))}}
    settings["solver"]["boundaries"] = [pin]
    (place / "flag.yaml").write_text(yaml.safe_dump(settings))
    simulation = Simulation.from_yaml(place / "flag.yaml", device="cpu")
    simulation.run(place / "run", FRAMES, progress=False)
    return simulation, place / "run"


def test_the_frames_of_a_run_are_those_of_its_simulation(recorded):
    """Places to the rounding of float16, shapes to that of the gradient, colours with the edit at its time."""
    simulation, run = recorded
    for frame, found in zip(simulation.frames(FRAMES), RecordedRun(run).frames(), strict=True):
        expected, scene = frame.gaussians.to_cloud(), simulation.scene
        moved = float(peak(frame.gaussians.means - scene.model.means))
        own = found.to_cloud()
        torch.testing.assert_close(own.means, expected.means, rtol=0, atol=2**-10 * moved + 1e-6)
        shapes = frame.gaussians.covariances
        near = 2**-9 * float(peak(shapes))  # F, rounded to 2^-11, is in both factors of F A F^T
        torch.testing.assert_close(found.covariances, shapes, rtol=0, atol=near)
        torch.testing.assert_close(own.sh, expected.sh, rtol=0, atol=2e-3)
        green = own.sh[scene.moving, 0, 0] < -1.5
        assert bool(green.all()) == (frame.index >= 2)
    assert moved > 0.01


@pytest.mark.parametrize("format", FORMATS)
def test_a_run_is_exported_in_every_format(recorded, format, tmp_path, capsys):
    simulation, run = recorded
    if format == "usd":
        pytest.importorskip("pxr")
        assert export([str(run), str(tmp_path / "new/film.usdc")]) == 0
        return _check_film(simulation, run, tmp_path / "new/film.usdc")
    ending = FORMATS[format].endings[0]
    name = f"new/f_##{ending}"
    assert export([str(run), str(tmp_path / name)]) == 0
    out = capsys.readouterr().out
    assert f"wrote {tmp_path / name}, {FRAMES} files" in out
    assert ("up [0.0, 1.0, 0.0], 1 scene unit = 2 m (from the run)" in out) == (format == "glb")
    place = simulation.scene.frame
    for index, gaussians in enumerate(RecordedRun(run).frames()):
        one = tmp_path / f"one{ending}"
        export_cloud(one, gaussians, metres_per_unit=place.metres_per_unit, rotation=place.rotation)
        assert (tmp_path / f"new/f_{index:02d}{ending}").read_bytes() == one.read_bytes()
    assert len(list((tmp_path / "new").iterdir())) == FRAMES


def _check_film(simulation, run, path):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    rate = stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()
    assert rate == (0, FRAMES - 1, 1 / simulation.frame_dt)
    prim = stage.GetPrimAtPath("/World/Gaussians")
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0))[:3, :3]
    for index, gaussians in enumerate(RecordedRun(run).frames()):
        points = np.array(prim.GetAttribute("positions").Get(index), dtype=np.float64)
        np.testing.assert_allclose(points, gaussians.means.numpy(), atol=1e-6)
        metres = torch.from_numpy(points @ matrix * UsdGeom.GetStageMetersPerUnit(stage))
        expected = simulation.scene.frame.point_to_sim(gaussians.means.double())
        torch.testing.assert_close(metres - metres[0], expected - expected[0], rtol=0, atol=1e-5)


def test_what_never_moves_is_written_once(recorded, tmp_path):
    simulation, run = recorded
    assert export([str(run), str(tmp_path / "f_#.ply"), "--apart"]) == 0
    moving = simulation.scene.moving
    still = torch.ones(96, dtype=torch.bool).index_fill(0, moving, False).nonzero()[:, 0]
    kept = read_ply(tmp_path / "f_still.ply")
    assert 2 * len(moving) < 96
    for index, gaussians in enumerate(RecordedRun(run).frames()):
        export_cloud(tmp_path / "whole.ply", gaussians)
        whole = read_ply(tmp_path / "whole.ply").select(torch.cat([still, moving]))
        found = joined(kept, read_ply(tmp_path / f"f_{index}.ply"))
        for name in ("means", "scales", "opacities", "sh", "normals"):
            assert torch.equal(getattr(found, name), getattr(whole, name)), name


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["f.ply"], "need a file each: give a target with # for their numbers, such as frame_####.ply, or one that"),
        (["f_#.glb", "--up", "0", "1", "0"], "--up is not for the frames of a run"),
        (["f_#.ply", "--spz-version", "3"], "--spz-version is not for the frames of a run as .ply"),
        (["f_#.obj"], "Cannot tell the format of"),
    ],
)
def test_what_is_refused(recorded, options, words, tmp_path, capsys):
    refused(export, [str(recorded[1]), str(tmp_path / options[0]), *options[1:]], capsys, words, folder=tmp_path)


def test_a_run_without_its_motion_is_refused(recorded, tmp_path, capsys):
    simulation, run = recorded
    copy = shutil.copytree(run, tmp_path / "run")
    for name in ("nodes.npz", "trajectory.npz"):
        (copy / name).unlink(missing_ok=True)
    lacking = "trajectory" if simulation.solver.formulation == "updated" else "nodes"
    words = f"has no {lacking}.npz, which moves the Gaussians: run it again with `recorder.{lacking}: true`"
    refused(export, [str(copy), str(tmp_path / "f_#.ply")], capsys, words)
    (copy / "summary.json").write_text(json.dumps({}))
    refused(export, [str(copy), str(tmp_path / "f_#.ply")], capsys, "summary.json cannot be read ('formulation')")
    shutil.copy(run / "summary.json", copy)
    (copy / "config.yaml").write_text((run / "config.yaml").read_text()[:40] + "\n  E: [")
    refused(export, [str(copy), str(tmp_path / "f_#.ply")], capsys, "config.yaml cannot be read (", "from a file")
    refused(export, [str(tmp_path), str(tmp_path / "f_#.ply")], capsys, "has no run: give the output folder")
    assert not list(tmp_path.glob("f_*"))


def test_a_frame_saves_its_gaussians(recorded, tmp_path):
    simulation, _ = recorded
    (frame,) = simulation.frames(1)
    for format, known in FORMATS.items():
        if format != "usd":
            path = tmp_path / f"a{known.endings[0]}"
            frame.save(path)
            frame.save(tmp_path / "b", format=format)
            assert path.read_bytes() == (tmp_path / "b").read_bytes()
            assert len(read_gaussians(path)) == 96
    frame.save(tmp_path / "a.png")
    shown = (frame.render().color.clamp(0, 1) * 255).round().numpy()
    assert np.abs(iio.imread(tmp_path / "a.png") - shown).max() <= 1
    away = LookAtCamera((0.0, -9.0, 0.0), (0.0, -99.0, 0.0), width=32, height=18)
    (unseen,) = Simulation(FlagScene(spacing=0.1), camera=away, hold=up_to(x=0.2), device="cpu").frames(1)
    with user_warning("shows nothing: check the place of the camera and its `near`"):
        unseen.save(tmp_path / "a.png")
    up = read_gaussians(tmp_path / "a.glb").means - 2 * frame.gaussians.means  # in metres, y up as in the scene
    torch.testing.assert_close(up, torch.zeros_like(up), rtol=0, atol=1e-5)
    before = sorted(tmp_path.iterdir())
    with value_error(r"Cannot tell the format of .*frame\.obj: .*\.splat"):
        frame.save(tmp_path / "frame.obj")
    with value_error(f"`format` to be one of {', '.join(FORMATS)}"):
        frame.save(tmp_path / "frame.ply", format="obj")
    with pytest.raises(FileNotFoundError, match="is not a folder; create it first"):
        frame.save(tmp_path / "none" / "0001.ply")
    with value_error("have no opacities: set `model`"):
        export_cloud(tmp_path / "c.ply", replace(frame.gaussians, model=None))
    assert sorted(tmp_path.iterdir()) == before
