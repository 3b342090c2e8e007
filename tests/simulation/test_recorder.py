"""What a run leaves on disk, and what it leaves when something breaks."""

import csv
import json
import math
import subprocess

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch

from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.gaussians.spherical_harmonics import sh_to_color
from gaussian_swaying.gaussians.surface import covariance
from gaussian_swaying.rendering.camera import OrbitCamera
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.recorder import (
    Recorder,
    atomic,
    encode_video,
    load_trajectory,
    write_json,
    write_table,
)


def _names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def _run(pipeline, folder, frames=3, recorder=None, **settings):
    return pipeline.run(recorder or Recorder(), folder, frames, progress=False, **settings)


# ---- files


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})

    def fail_half_way():
        with atomic(path) as temporary:
            temporary.write_text("{")
            assert temporary.parent == path.parent  # a rename across file systems is not atomic
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail_half_way()
    assert json.loads(path.read_text()) == {"a": 1}
    assert _names(tmp_path) == ["value.json"]


def _failing(monkeypatch, target, name):
    """Make a writer fail after it has written half a file."""

    def fail(path, *_, **__):
        assert not str(path).endswith("00001.png")  # never under its own name
        path.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(target, name, fail)


@pytest.mark.parametrize("what", ["image", "trajectory", "checkpoint", "ply", "summary"])
def test_a_failing_write_leaves_no_half_file(what, make_pipeline, tmp_path, monkeypatch):
    recorder = Recorder(ply_every=1)
    recorder.open(tmp_path / "run")
    before = _names(tmp_path)
    if what == "image":
        _failing(monkeypatch, iio, "imwrite")
        write = lambda: recorder.write_image(1, torch.zeros(2, 2, 3))  # noqa: E731
    elif what == "trajectory":
        _failing(monkeypatch, np, "savez")
        write = lambda: recorder.write_trajectory(1, torch.zeros(2, 3), torch.zeros(2, 3, 3))  # noqa: E731
    elif what == "checkpoint":
        monkeypatch.setattr(torch, "save", lambda _, path: (path.write_bytes(b"half"), 1 / 0))
        write = lambda: recorder.write_checkpoint({"frame": 1})  # noqa: E731
    elif what == "ply":
        import plyfile

        pipeline = make_pipeline()

        def fail(self, path):
            with open(path, "wb") as stream:
                stream.write(b"half")
            raise OSError("No space left on device")

        monkeypatch.setattr(plyfile.PlyData, "write", fail)
        write = lambda: recorder.write_ply(1, lambda p: pipeline.export(pipeline.scene.rest(), p))  # noqa: E731
    else:
        write = lambda: recorder.write_summary({"a": object()})  # noqa: E731
    with pytest.raises((OSError, ZeroDivisionError, TypeError)):
        write()
    assert _names(tmp_path) == before


def test_files_of_a_run(make_pipeline, tmp_path):
    _run(make_pipeline(), tmp_path / "run", recorder=Recorder(ply_every=2), config="frames: 3\n")
    assert _names(tmp_path / "run") == [
        "checkpoint.pt",
        "config.yaml",
        "diagnostics.csv",
        "frames",
        "frames/00000.png",
        "frames/00001.png",
        "frames/00002.png",
        "ply",
        "ply/00000.ply",
        "ply/00002.ply",
        "run.json",
        "summary.json",
        "trajectory.npz",
        "video.mp4",
    ]
    assert (tmp_path / "run" / "config.yaml").read_text() == "frames: 3\n"


def test_diagnostics_are_a_table_too(make_pipeline, tmp_path):
    """One row per frame with the numbers of summary.json, readable by any spreadsheet."""
    summary = _run(make_pipeline(), tmp_path / "run")
    with (tmp_path / "run" / "diagnostics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(summary["per_frame"]) == 3
    for row, entry in zip(rows, summary["per_frame"], strict=True):
        assert {name: float(value) for name, value in row.items()} == pytest.approx(entry)
    assert float(rows[-1]["wind_work"]) > 0


def test_rows_of_an_older_run_leave_their_gaps(tmp_path):
    write_table(tmp_path / "table.csv", [{"a": 1}, {"a": 2, "b": 3}])
    with (tmp_path / "table.csv").open(newline="") as file:
        assert list(csv.DictReader(file)) == [{"a": "1", "b": ""}, {"a": "2", "b": "3"}]


def test_what_is_switched_off_is_not_written(make_pipeline, tmp_path):
    recorder = Recorder(images=False, video=False, trajectory=False, checkpoint_every=0)
    _run(make_pipeline(), tmp_path / "run", recorder=recorder)
    assert _names(tmp_path / "run") == ["diagnostics.csv", "run.json", "summary.json"]
    with pytest.raises(ValueError, match=r"`recorder.images`"):
        Recorder(images=False)
    for name, value in (("ply_every", -1), ("checkpoint_every", -1), ("fps", 0.0)):
        with pytest.raises(ValueError, match=name):
            Recorder(**{name: value})


def test_images_are_the_pictures_rounded_to_8_bits(make_pipeline, tmp_path):
    pipeline = make_pipeline(background=(0.25, 0.5, 1.0))
    _run(pipeline, tmp_path / "run", 1)
    stored = iio.imread(tmp_path / "run" / "frames" / "00000.png")
    color = pipeline.render(pipeline.start(), 0).color
    assert stored.shape == (18, 32, 3)
    assert stored[0, 0].tolist() == [64, 128, 255]
    assert np.abs(stored / 255 - color.numpy()).max() <= 0.5 / 255 + 1e-6


# ---- trajectory and .ply


def test_the_trajectory_holds_every_frame(make_pipeline, tmp_path):
    pipeline = make_pipeline()
    _run(pipeline, tmp_path / "run")
    state = pipeline.start()
    for frame in range(3):
        if frame:
            state, _ = pipeline.advance(state)
        position, F = load_trajectory(tmp_path / "run" / "trajectory.npz", frame)
        assert torch.equal(position, state.position)
        torch.testing.assert_close(F, state.F_total, rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match="holds no frame 3: it has 3 frames"):
        load_trajectory(tmp_path / "run" / "trajectory.npz", 3)


def test_exported_gaussians_are_the_deformed_ones(make_cloud, make_pipeline, tmp_path):
    """Log scales, logit opacities, unit quaternions wxyz, means in scene units, harmonics turned with the patches."""
    cloud = make_cloud()
    settings = {"pinned": False, "scene": {"up": [0.0, -1.0, 0.0], "longest_side": 0.7}}
    pipeline = make_pipeline(cloud, wind=WindField([0.0, 9.0, 0.0]), **settings)
    _run(pipeline, tmp_path / "run", recorder=Recorder(ply_every=1))
    state = pipeline.start()
    rest = read_ply(tmp_path / "run" / "ply" / "00000.ply")
    torch.testing.assert_close(rest.sh, cloud.sh, rtol=0, atol=1e-5)
    for _ in range(2):
        state, _ = pipeline.advance(state)
    deformed = pipeline.scene.deformed(state)
    found = read_ply(tmp_path / "run" / "ply" / "00002.ply")
    assert float((deformed.means - cloud.means).abs().max()) > 0.01
    torch.testing.assert_close(found.means, deformed.means)
    torch.testing.assert_close(found.quats.norm(dim=-1), torch.ones(40), rtol=0, atol=1e-5)
    torch.testing.assert_close(covariance(found.quats, found.scales), deformed.covariances, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(found.opacities, cloud.opacities)
    camera = pipeline.camera_at(2).to(dtype=torch.float32)
    seen = sh_to_color(found.sh, found.means - camera.position)
    torch.testing.assert_close(seen, pipeline.colors(deformed, camera), rtol=0, atol=1e-4)
    unturned = sh_to_color(cloud.sh, found.means - camera.position)
    assert float((seen - unturned).abs().max()) > 0.01
    torch.testing.assert_close(found.normals, deformed.normals)
    torch.testing.assert_close(found.normals.norm(dim=-1), torch.ones(40))


# ---- video


def _probe(path):
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)], capture_output=True, text=True)
    return next(line for line in done.stderr.splitlines() if "Video:" in line)


def test_the_video(make_pipeline, tmp_path):
    """As many frames as pictures, even sides though the pictures are odd, in the format that every player knows."""
    pipeline = make_pipeline(camera=OrbitCamera(width=33, height=19, azimuth=-70.0, radius=1.9))
    _run(pipeline, tmp_path / "run", 4)
    frames = iio.imread(tmp_path / "run" / "video.mp4")
    assert frames.shape == (4, 20, 34, 3)
    line = _probe(tmp_path / "run" / "video.mp4")
    assert "h264" in line
    assert "yuv420p" in line
    assert "34x20" in line
    assert "25 fps" in line
    assert iio.imread(tmp_path / "run" / "frames" / "00000.png").shape == (19, 33, 3)


def test_video_frames_are_in_order_at_the_rate_asked_for(tmp_path):
    files = []
    for k in range(5):
        files.append(tmp_path / f"{k}.png")
        iio.imwrite(files[-1], np.full((16, 16, 3), 50 * k, dtype=np.uint8))
    encode_video(files, tmp_path / "out.mp4", 10.0)
    frames = iio.imread(tmp_path / "out.mp4")
    assert [round(float(frame.mean()) / 50) for frame in frames] == [0, 1, 2, 3, 4]
    assert "10 fps" in _probe(tmp_path / "out.mp4")


def test_a_video_that_cannot_be_made_loses_nothing_else(make_pipeline, tmp_path, monkeypatch):
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "false")
    with pytest.raises(OSError, match=r"ffmpeg could not write video\.mp4"):
        _run(make_pipeline(), tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] == 3
    load_trajectory(tmp_path / "run" / "trajectory.npz", 2)
    assert not [name for name in _names(tmp_path / "run") if "mp4" in name]


# ---- summary


def test_the_summary(make_pipeline, tmp_path):
    pipeline = make_pipeline(wind=WindField([6.0, 1.5, 0.0], seed=7))
    returned = _run(pipeline, tmp_path / "run", 3, settings={"note": "kept"})
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary == json.loads(json.dumps(returned))
    assert (summary["status"], summary["reason"], summary["note"]) == ("complete", None, "kept")
    assert summary["device"]
    assert summary["versions"]["torch"] == torch.__version__
    assert {"python", "gaussian_swaying", "gsplat", "numpy"} <= set(summary["versions"])
    assert (summary["seed"], summary["particles"], summary["gaussians"]) == (7, 96, 96)
    assert summary["grid"]["dx_m"] == 0.2
    assert len(summary["grid"]["resolution"]) == 3
    assert (summary["frames"], summary["frames_wanted"]) == (3, 3)
    assert summary["simulated_s"] == pytest.approx(0.08)
    assert set(summary["wall_s"]) == {"simulation", "shading", "rendering", "writing"}
    assert all(seconds > 0 for seconds in summary["wall_s"].values())
    assert summary["peak_memory_bytes"]["host"] > 2**20
    assert summary["peak_memory_bytes"]["device"] is None
    state, log = pipeline.start(), []
    start = pipeline.solver.energies(state)
    for _ in range(2):
        state, health = pipeline.advance(state)
        log.append(health)
    end = pipeline.solver.energies(state)
    for name in ("kinetic", "elastic", "potential"):
        assert summary["energy_start_J"][name] == pytest.approx(float(start[name]), abs=1e-9)
        assert summary["energy_end_J"][name] == pytest.approx(float(end[name]))
    assert summary["substeps"] == sum(health.substeps for health in log)
    assert summary["largest_cfl"] == pytest.approx(max(health.cfl for health in log))
    assert 0.2 < summary["largest_cfl"] <= 0.5
    assert len(summary["per_frame"]) == 3


# ---- a run that ends badly


def _fail_at(pipeline, monkeypatch, frame, error):
    advance, done = pipeline.advance, []

    def fail(state):
        if len(done) == frame - 1:
            raise error
        done.append(1)
        return advance(state)

    monkeypatch.setattr(pipeline, "advance", fail)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (SimulationDiverged(0.12, 3, "broken", "mend it"), "diverged"),
        (KeyboardInterrupt(), "interrupted"),
        (ValueError("something else"), "failed"),
    ],
)
def test_what_was_recorded_before_the_end_is_kept(error, status, make_pipeline, tmp_path, monkeypatch):
    pipeline, folder = make_pipeline(), tmp_path / "run"
    _fail_at(pipeline, monkeypatch, 3, error)
    with pytest.raises(type(error)):
        _run(pipeline, folder, 10, Recorder(ply_every=1))
    assert len(list((folder / "frames").glob("*.png"))) == 3
    assert len(list((folder / "ply").glob("*.ply"))) == 3
    assert len(iio.imread(folder / "video.mp4")) == 3
    load_trajectory(folder / "trajectory.npz", 2)
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["status"], summary["frames"], summary["frames_wanted"]) == (status, 3, 10)
    assert status == "interrupted" or str(error) == summary["reason"]
    assert not [name for name in _names(folder) if "/." in name or name.startswith(".")]


def test_a_run_that_diverges_by_itself_is_kept(make_pipeline, tmp_path):
    """The wind rises to a hurricane at 0.1 s with a substep that is too long for it."""
    from gaussian_swaying.aero.wind import FlowKey

    wind = WindField(schedule=[FlowKey(0.0, [2.0, 0.5, 0.0]), FlowKey(0.1, [0.0, 3000.0, 0.0])])
    pipeline = make_pipeline(wind=wind, cfl=0.4)
    with pytest.raises(SimulationDiverged, match="Remedy"):
        _run(pipeline, tmp_path / "run", 40)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["status"] == "diverged"
    assert 3 <= summary["frames"] < 40
    assert "Remedy" in summary["reason"]
    assert math.isfinite(summary["largest_cfl"])
    assert len(iio.imread(tmp_path / "run" / "video.mp4")) == summary["frames"]


# ---- the folder


def test_an_earlier_run_is_moved_aside(make_pipeline, tmp_path, capsys):
    _run(make_pipeline(), tmp_path / "run", 2)
    (tmp_path / "run" / "mine.txt").write_text("precious")
    _run(make_pipeline(), tmp_path / "run", 1)
    _run(make_pipeline(), tmp_path / "run", 1)
    assert len(list((tmp_path / "run.1" / "frames").glob("*.png"))) == 2
    assert (tmp_path / "run.1" / "mine.txt").read_text() == "precious"
    assert len(list((tmp_path / "run.2" / "frames").glob("*.png"))) == 1
    assert "run.1" in capsys.readouterr().out


def test_foreign_files_are_left_alone(make_pipeline, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("precious")
    _run(make_pipeline(), folder, 1)
    assert (folder / "notes.txt").read_text() == "precious"


@pytest.mark.parametrize("name", ["summary.json", "frames/00000.png", "trajectory/walk.npz", "config.yaml"])
def test_foreign_files_are_not_overwritten(name, make_pipeline, tmp_path):
    """They bear a name that the run would write, but no run made them."""
    file = tmp_path / "mine" / name
    file.parent.mkdir(parents=True)
    file.write_text("precious")
    with pytest.raises(ValueError, match=r"mine holds \w+.* choose another with --output"):
        _run(make_pipeline(), tmp_path / "mine", 1)
    assert file.read_text() == "precious"
    assert len([path for path in (tmp_path / "mine").rglob("*") if path.is_file()]) == 1


def test_a_recorder_without_a_folder():
    with pytest.raises(RuntimeError, match=r"`open\(folder\)`"):
        Recorder().write_summary({})
