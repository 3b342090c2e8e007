"""Formats in which a run leaves its Gaussians.

Covers: recording.writer.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from gaussian_swaying.gaussians.export import SUFFIXES, export_cloud, read_usd_frame
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.recording import recorder as recorder_module
from gaussian_swaying.recording.recorder import Recorder

QUIET = {"video": False, "images": False, "trajectory": False}


@pytest.mark.parametrize(
    ("format", "suffix", "size"), [("splat", ".splat", 96 * 32), ("compressed_ply", ".compressed.ply", None)]
)
def test_small_formats(format, suffix, size, make_simulation, tmp_path):
    simulation = make_simulation()
    simulation.run(tmp_path / "run", 3, progress=False, recorder=Recorder(ply_every=2, export_format=format, **QUIET))
    files = sorted((tmp_path / "run" / format).iterdir())
    assert [file.name for file in files] == [f"00000{suffix}", f"00002{suffix}"]
    assert files[0].read_bytes() != files[1].read_bytes()
    assert size is None or files[0].stat().st_size == size
    assert tmp_path / "run" / format in simulation.files


@pytest.mark.parametrize(("format", "suffix"), [(k, v) for k, v in SUFFIXES.items() if k != "usd"])
def test_a_frame_saves_what_a_run_writes(format, suffix, make_simulation, tmp_path):
    """By the ending, by the option, and its Gaussians alone; frames whose Gaussians are turned and stretched."""
    recorder = Recorder(ply_every=1, export_format=format, **QUIET)
    make_simulation().run(tmp_path / "run", 3, progress=False, recorder=recorder)
    for frame in make_simulation().frames(3):
        frame.save(tmp_path / f"{frame.index:05d}{suffix}")
        frame.save(tmp_path / "other", format=format)
        export_cloud(tmp_path / f"again{suffix}", frame.gaussians)
        expected = (tmp_path / "run" / format / f"{frame.index:05d}{suffix}").read_bytes()
        assert (tmp_path / f"{frame.index:05d}{suffix}").read_bytes() == expected
        assert (tmp_path / "other").read_bytes() == (tmp_path / f"again{suffix}").read_bytes() == expected


@pytest.mark.parametrize("format", ["ply", "compressed_ply"])
def test_supersplat_takes_the_frames_for_a_sequence(format, make_simulation, tmp_path):
    """Its rule (isPlySequence in src/file-handler.ts): the same words before a number, and .ply after it."""
    make_simulation().run(
        tmp_path / "run", 3, progress=False, recorder=Recorder(ply_every=1, export_format=format, **QUIET)
    )
    names = [path.name for path in (tmp_path / "run" / format).iterdir()]
    found = [re.search(r"(.*?)(\d+)(?:\.compressed)?\.ply$", name) for name in names]
    assert {match[1] for match in found} == {""}
    assert sorted(int(match[2]) for match in found) == [0, 1, 2]


def test_a_frame_is_saved_as_usd_in_metres(make_simulation, tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    scene = {"up": [0.0, 1.0, 0.0], "metres_per_unit": 2.0}
    (frame,) = make_simulation(scene=scene, pinned=False).frames(1)
    frame.save(tmp_path / "one.usda")
    recorder = Recorder(ply_every=1, export_format="usd", **QUIET)
    make_simulation(scene=scene, pinned=False).run(tmp_path / "run", 1, progress=False, recorder=recorder)
    stages = [Usd.Stage.Open(str(tmp_path / name)) for name in ("one.usda", "run/animation.usdc")]
    assert [UsdGeom.GetStageMetersPerUnit(stage) for stage in stages] == [2.0, 2.0]
    assert [stage.GetFramesPerSecond() for stage in stages] == [25.0, 25.0]
    turned = [
        np.array(UsdGeom.Xformable(s.GetPrimAtPath("/World/Gaussians")).ComputeLocalToWorldTransform(0)) for s in stages
    ]
    np.testing.assert_array_equal(*turned)
    for name, array in read_usd_frame(tmp_path / "one.usda", 0).items():
        np.testing.assert_array_equal(array, read_usd_frame(tmp_path / "run/animation.usdc", 0)[name])


def test_a_frame_that_cannot_be_saved(make_simulation, tmp_path):
    (frame,) = make_simulation().frames(1)
    with pytest.raises(ValueError, match=r"Cannot tell the format of .*frame\.obj: .*\.splat"):
        frame.save(tmp_path / "frame.obj")
    with pytest.raises(ValueError, match=f"`format` to be one of {', '.join(SUFFIXES)}"):
        frame.save(tmp_path / "frame.ply", format="obj")
    with pytest.raises(FileNotFoundError, match="is not a folder; create it first"):
        frame.save(tmp_path / "none" / "0001.ply")
    alone = replace(frame.gaussians, model=None)
    with pytest.raises(ValueError, match="have no opacities: set `model`"):
        export_cloud(tmp_path / "a.ply", alone)
    assert not list(tmp_path.iterdir())


def test_a_film_in_usd(make_simulation, tmp_path):
    """Every frame of the run, resumed or not, as its .ply has it; metres, z up and the time of the run."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    folder, scene = tmp_path / "run", {"metres_per_unit": 2.0}
    for frames in (2, 4):
        usd = Recorder(ply_every=1, export_format="usd", **QUIET)
        simulation = make_simulation(scene=scene)
        simulation.run(folder, frames, resume=frames > 2, progress=False, recorder=usd)
    plain = make_simulation(scene=scene)
    plain.run(tmp_path / "plain", 4, progress=False, recorder=Recorder(ply_every=1, **QUIET))
    for frame in range(4):
        found, expected = (
            read_usd_frame(folder / "animation.usdc", frame),
            read_ply(tmp_path / "plain" / "ply" / f"{frame:05d}.ply"),
        )
        np.testing.assert_allclose(found["positions"], expected.means.numpy(), atol=1e-6)
        shape = covariance(torch.from_numpy(found["orientations"]), torch.from_numpy(found["scales"]).log())
        torch.testing.assert_close(shape, covariance(expected.quats, expected.scales), rtol=1e-4, atol=1e-8)
    assert not np.allclose(found["positions"], read_usd_frame(folder / "animation.usdc", 0)["positions"], atol=1e-3)
    stage = Usd.Stage.Open(str(folder / "animation.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 3, 25)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 2.0
    assert not (folder / "usd").exists()
    assert folder / "animation.usdc" in simulation.files


def test_the_up_direction_of_a_film_is_z(flag_ply, make_simulation, tmp_path):
    """In the world of the film every Gaussian is where the simulation has it, up to scale and origin."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    settings = {"up": [0.0, 1.0, 0.0], "longest_side": 1.2}
    simulation = make_simulation(read_ply(flag_ply), pinned=False, scene=settings)
    usd = Recorder(ply_every=1, export_format="usd", **QUIET)
    simulation.run(tmp_path / "run", 1, progress=False, recorder=usd)
    stage = Usd.Stage.Open(str(tmp_path / "run" / "animation.usdc"))
    prim = stage.GetPrimAtPath("/World/Gaussians")
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0))
    points = np.array(prim.GetAttribute("positions").Get(0), dtype=np.float64) @ matrix[:3, :3]
    points = points * UsdGeom.GetStageMetersPerUnit(stage)
    expected = simulation.scene.points.position.double().numpy()
    np.testing.assert_allclose(points - points.mean(0), expected - expected.mean(0), atol=1e-5)


def test_usd_without_its_library_is_refused_at_once(monkeypatch):
    monkeypatch.setattr(recorder_module, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs usd-core: .*`recorder.export_format`"):
        Recorder(ply_every=1, export_format="usd")
    Recorder(export_format="usd")  # nothing would be written
    with pytest.raises(ValueError, match=rf"`recorder\.export_format` to be one of {', '.join(SUFFIXES)}"):
        Recorder(export_format="obj")
