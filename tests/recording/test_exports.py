"""Formats in which a run leaves its Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaussian_swaying.cli.export import main as export
from gaussian_swaying.gaussians.cloud import joined
from gaussian_swaying.gaussians.export import SUFFIXES, convert, export_cloud, read_usd_frame
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.recording import recorder as recorder_module
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.edits import Edit

QUIET = {"video": False, "images": False, "trajectory": False}


@pytest.mark.parametrize(("format", "suffix"), [(k, v) for k, v in SUFFIXES.items() if k != "usd"])
def test_a_frame_saves_what_a_run_writes(format, suffix, make_simulation, tmp_path):
    """By the ending, by the option, and its Gaussians alone; frames whose Gaussians are turned and stretched."""
    recorder = Recorder(ply_every=1, export_format=format, **QUIET)
    simulation = make_simulation()
    simulation.run(tmp_path / "run", 3, progress=False, recorder=recorder)
    assert tmp_path / "run" / format in simulation.files
    for frame in make_simulation().frames(3):
        frame.save(tmp_path / f"{frame.index:05d}{suffix}")
        frame.save(tmp_path / "other", format=format)
        export_cloud(tmp_path / f"again{suffix}", frame.gaussians)
        expected = (tmp_path / "run" / format / f"{frame.index:05d}{suffix}").read_bytes()
        assert (tmp_path / f"{frame.index:05d}{suffix}").read_bytes() == expected
        assert (tmp_path / "other").read_bytes() == (tmp_path / f"again{suffix}").read_bytes() == expected


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


# ---- what stands still, once

LOW = {"region": Box([None, None, 0.62], [None, None, None])}
"""Of the flag only the upper part moves, less than half of it."""


@pytest.fixture
def recorded(make_simulation, tmp_path):
    """Runs the upper part of a flag with harmonics that turn; returns the simulation and its folder."""

    def run(name, frames=3, resume=False, edits=(), **recorder):
        scene = FlagScene(spacing=0.1).generate()
        harmonics = torch.randn(len(scene), 3, 3, generator=torch.Generator().manual_seed(1))
        scene = replace(scene, sh=torch.cat([scene.sh[:, :1], 0.1 * harmonics], 1))
        simulation = make_simulation(scene, scene=LOW, parts={"edits": list(edits)})
        recorder = Recorder(**QUIET, **({"ply_every": 1} | recorder))
        simulation.run(tmp_path / name, frames, resume=resume, progress=False, recorder=recorder)
        return simulation, tmp_path / name

    return run


def _equal(one, other, written=1):
    """The same numbers; quaternions get their length anew whenever they are written."""
    for name in ("means", "scales", "opacities", "sh", "normals"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    torch.testing.assert_close(one.quats, other.quats, rtol=0.0, atol=(written - 1) * 1e-7)


def test_what_stands_still_is_written_once(recorded):
    """Both parts together are the whole frame, exactly; also in another format, and after a resumed run."""
    simulation, whole = recorded("whole", ply_still="frames")
    _, apart = recorded("apart", 2)
    recorded("apart", 3, resume=True)
    moving = simulation.scene.moving
    still = torch.ones(96, dtype=torch.bool).index_fill(0, moving, False).nonzero()[:, 0]
    assert 2 * len(moving) < 96
    kept = read_ply(apart / "still.ply")
    assert len(kept) == len(still)
    source = simulation.scene.model.to_cloud().select(still)
    assert torch.equal(kept.means, source.means)
    assert torch.equal(kept.scales, source.scales)
    for frame in range(3):
        expected = read_ply(whole / "ply" / f"{frame:05d}.ply").select(torch.cat([still, moving]))
        own = read_ply(apart / "ply" / f"{frame:05d}.ply")
        assert len(own) == len(moving)
        _equal(joined(kept, own), expected)
    assert not torch.equal(own.means, simulation.scene.model.means[moving])
    assert not (whole / "still.ply").exists()
    sizes = [sum(file.stat().st_size for file in (folder / "ply").iterdir()) for folder in (whole, apart)]
    assert sizes[1] < sizes[0] * (len(moving) / 96 + 0.1)


def test_frames_of_a_folder_get_what_stands_still(recorded, tmp_path, capsys):
    simulation, whole = recorded("whole", ply_still="frames")
    _, apart = recorded("apart")
    assert export([str(apart / "ply"), str(tmp_path / "frame_#.ply")]) == 0
    still = torch.ones(96, dtype=torch.bool).index_fill(0, simulation.scene.moving, False).nonzero()[:, 0]
    order = torch.cat([still, simulation.scene.moving])
    for frame in range(3):
        _equal(read_ply(tmp_path / f"frame_{frame}.ply"), read_ply(whole / f"ply/{frame:05d}.ply").select(order), 2)
    (apart / "run.json").unlink()  # a folder that no run made: the file beside it is another one
    assert export([str(apart / "ply"), str(tmp_path / "frame_#.ply")]) == 0
    assert len(read_ply(tmp_path / "frame_0.ply")) == len(simulation.scene.moving)


@pytest.mark.parametrize("format", ["splat", "compressed_ply", "glb"])
def test_the_still_part_has_the_format_of_the_frames(recorded, format):
    simulation, folder = recorded("run", export_format=format)
    still = read_gaussians(folder / f"still{SUFFIXES[format]}")
    frame = read_gaussians(folder / format / f"00001{SUFFIXES[format]}")
    assert len(still) + len(frame) == 96
    assert folder / f"still{SUFFIXES[format]}" in simulation.files


def test_where_the_still_part_is_written(recorded, make_simulation, tmp_path):
    """By itself where most stands still and keeps its colours; as asked; else a sentence."""
    late = Edit(color=[1.0, 0.0, 0.0], time=0.04, region=Box([None] * 3, [None] * 3))
    for name, expected, settings in (
        ("start", True, {"edits": [replace(late, time=0.0)]}),
        ("mine", True, {"edits": [replace(late, region=None)]}),
        ("late", False, {"edits": [late]}),
        ("none", False, {"ply_every": 0}),
    ):
        _, folder = recorded(name, 2, **settings)
        assert (folder / "still.ply").exists() == expected, name
    assert float(read_ply(tmp_path / "start/still.ply").sh[:, 0, 1].max()) < 0  # no green
    with pytest.raises(ValueError, match=r"colours Gaussians that never move, .*`recorder\.ply_still` to frames"):
        recorded("refused", edits=[late], ply_still="once")
    with pytest.raises(ValueError, match=r"All Gaussians of the scene move: set `recorder\.ply_still` to auto"):
        make_simulation().run(tmp_path / "all", 1, progress=False, recorder=Recorder(ply_every=1, ply_still="once"))
    make_simulation().run(tmp_path / "all", 1, progress=False, recorder=Recorder(ply_every=1, **QUIET))
    assert not (tmp_path / "all/still.ply").exists()


def test_a_run_does_not_change_where_its_still_part_is(recorded):
    _, folder = recorded("run", 2)
    with pytest.raises(ValueError, match=r"are without what never moves: resume with the same `recorder\.ply_still`"):
        recorded("run", 3, resume=True, ply_still="frames")
    (folder / "still.ply").unlink()
    recorded("run", 3, resume=True)
    assert len(read_ply(folder / "still.ply")) + len(read_ply(folder / "ply/00002.ply")) == 96


def test_parts_that_do_not_belong_together(tmp_path):
    cloud = FlagScene(spacing=0.1).generate()
    (tmp_path / "ply").mkdir()
    export_cloud(tmp_path / "still.ply", cloud)
    export_cloud(tmp_path / "ply/00000.ply", replace(cloud, sh=cloud.sh.repeat(1, 4, 1)))
    with pytest.raises(ValueError, match=r"harmonics of degree 0 and 1\): give the folder of a run"):
        convert(tmp_path / "ply", tmp_path / "#.spz", still=tmp_path / "still.ply")
