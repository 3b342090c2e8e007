"""What a run leaves on disk, and what it leaves when something breaks."""

import gc
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from shared import advanced, near, peak, rows, value_error, without_waits

from gaussian_swaying.config.parser import applied
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.recording import recorder as recorder_module
from gaussian_swaying.recording import trajectory
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.recording.video import VideoEncoder, encode_video
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.record import Run
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import WindField

FLAG = FlagScene(spacing=0.3).generate()


def _names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def _run(simulation, folder, frames=3, recorder=None, **settings):
    return simulation.run(folder, frames, progress=False, **settings, recorder=recorder or Recorder())


# ---- files


@pytest.mark.parametrize(
    ("target", "write"),
    [
        ((recorder_module, "save_png"), lambda recorder: recorder.write_image(1, torch.zeros(2, 2, 3))),
        ((np, "savez"), lambda recorder: recorder.write_trajectory(1, torch.zeros(2, 3), torch.zeros(2, 3, 3))),
        ((torch, "save"), lambda recorder: recorder.write_checkpoint({"frame": 1})),
    ],
    ids=["image", "trajectory", "checkpoint"],
)
def test_a_failing_write_leaves_no_half_file(target, write, tmp_path, monkeypatch):
    def fail(*given, **_):
        path = next(Path(part) for part in given if isinstance(part, str | Path))
        assert path.name.startswith(".")  # never under its own name
        path.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(*target, fail)
    recorder = Recorder(video=False)
    recorder.open(tmp_path / "run")
    before = _names(tmp_path)
    write(recorder)
    with pytest.raises(OSError, match="could not be written: No space"):
        recorder.wait()
    assert _names(tmp_path) == before


def test_files_of_a_run(make_simulation, tmp_path):
    simulation = make_simulation()
    simulation.config = "frames: 3\n"
    _run(simulation, tmp_path / "run", recorder=Recorder())
    assert _names(tmp_path / "run") == [
        "checkpoint.pt",
        "config.yaml",
        "diagnostics.csv",
        "frames",
        "frames/00000.png",
        "frames/00001.png",
        "frames/00002.png",
        "nodes.npz",
        "run.json",
        "summary.json",
        "trajectory.npz",
        "video.mp4",
    ]
    assert (tmp_path / "run" / "config.yaml").read_text() == "frames: 3\n"


def test_diagnostics_are_a_table_too(make_simulation, tmp_path):
    summary = _run(make_simulation(), tmp_path / "run")
    table = rows(tmp_path / "run" / "diagnostics.csv")
    assert len(table) == len(summary["per_frame"]) == 3
    for row, entry in zip(table, summary["per_frame"], strict=True):
        assert {name: float(value) for name, value in row.items()} == pytest.approx(entry)
    assert float(table[-1]["wind_work"]) > 0


def test_what_is_switched_off_is_not_written(make_simulation, tmp_path):
    recorder = Recorder(renders=(), trajectory=False, checkpoint_every=0, nodes=False)
    _run(make_simulation(), tmp_path / "run", recorder=recorder)
    assert _names(tmp_path / "run") == ["config.yaml", "diagnostics.csv", "run.json", "summary.json"]
    for name, value in (("checkpoint_every", -1), ("fps", 0.0)):
        with value_error(name):
            Recorder(**{name: value})


def test_pictures_that_show_nothing_are_told(make_simulation, tmp_path, capsys):
    away = LookAtCamera((0.0, -2.0, 0.0), (0.0, -4.0, 0.0), width=32, height=18)
    simulation = make_simulation(parts={"cameras": {"away": away}})
    summary = simulation.run(tmp_path / "run", 3, recorder=Recorder())
    words = "3 pictures in cameras/away/frames show nothing, the first in frame 0: check `near`"
    assert [words in sentence for sentence in summary["warnings"]].count(True) == 1
    assert f"warning: {words}" in capsys.readouterr().err
    assert not any("in frames show nothing" in sentence for sentence in summary["warnings"])


def test_images_are_the_pictures_rounded_to_8_bits(make_simulation, tmp_path):
    simulation = make_simulation(background=(0.25, 0.5, 1.0))
    _run(simulation, tmp_path / "run", 1)
    stored = iio.imread(tmp_path / "run" / "frames" / "00000.png")
    color = simulation.painter.render(simulation.start(), 0).color
    assert stored.shape == (18, 32, 3)
    assert stored[0, 0].tolist() == [64, 128, 255]
    assert np.abs(stored / 255 - color.numpy()).max() <= 0.5 / 255 + 1e-6


# ---- trajectory and .ply


def test_the_trajectory_holds_every_frame(make_simulation, tmp_path):
    simulation = make_simulation()
    _run(simulation, tmp_path / "run")
    state = simulation.start()
    for frame in range(3):
        if frame:
            state, _ = simulation.advance(state)
        position, F = load_trajectory(tmp_path / "run" / "trajectory.npz", frame)
        assert torch.equal(position, state.position)
        torch.testing.assert_close(F, state.F_total, rtol=1e-3, atol=1e-3)
    with value_error("has no frame 3: it has 3 frames"):
        load_trajectory(tmp_path / "run" / "trajectory.npz", 3)


def test_exported_gaussians_are_the_deformed_ones(make_cloud, make_simulation, tmp_path):
    """Log scales, logit opacities, unit quaternions wxyz, means in scene units, harmonics turned with the patches."""
    cloud = make_cloud()
    settings = {"pinned": False, "scene": {"up": [0.0, -1.0, 0.0], "longest_side": 0.7}}
    simulation = make_simulation(cloud, wind=WindField([0.0, 9.0, 0.0]), **settings)
    for frame in simulation.frames(3):
        frame.save(tmp_path / f"{frame.index}.ply")
    rest = read_ply(tmp_path / "0.ply")
    near(rest.sh, cloud.sh, 1e-5)
    state, _ = advanced(simulation, 2)
    deformed = simulation.scene.deformed(state)
    found = read_ply(tmp_path / "2.ply")
    assert peak(deformed.means - cloud.means) > 0.01
    torch.testing.assert_close(found.means, deformed.means)
    near(found.quats.norm(dim=-1), torch.ones(40), 1e-5)
    torch.testing.assert_close(covariance(found.quats, found.scales), deformed.covariances, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(found.opacities, cloud.opacities)
    camera = simulation.painter.camera_at(2).to(dtype=torch.float32)
    seen = sh_to_color(found.sh, found.means - camera.position)
    near(seen, simulation.painter.colors(deformed, camera), 1e-4)
    unturned = sh_to_color(cloud.sh, found.means - camera.position)
    assert peak(seen - unturned) > 0.01
    torch.testing.assert_close(found.normals, deformed.normals)
    torch.testing.assert_close(found.normals.norm(dim=-1), torch.ones(40))


# ---- video


def _probe(path):
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)], capture_output=True, text=True)
    return next(line for line in done.stderr.splitlines() if "Video:" in line)


def test_the_video(make_simulation, tmp_path):
    """As many frames as pictures, even sides though the pictures are odd, in the format that every player knows."""
    simulation = make_simulation(camera=OrbitCamera(width=33, height=19, azimuth=-70.0, radius=1.9))
    _run(simulation, tmp_path / "run", 4)
    frames = iio.imread(tmp_path / "run" / "video.mp4")
    assert frames.shape == (4, 20, 34, 3)
    line = _probe(tmp_path / "run" / "video.mp4")
    assert "h264" in line
    assert "yuv420p" in line
    assert "34x20" in line
    assert "25 fps" in line
    assert iio.imread(tmp_path / "run" / "frames" / "00000.png").shape == (19, 33, 3)


def test_a_video_that_cannot_be_made_loses_nothing_else(make_simulation, tmp_path, monkeypatch):
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "false")
    with pytest.raises(OSError, match=r"ffmpeg could not write video\.mp4"):
        _run(make_simulation(), tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] == 3
    load_trajectory(tmp_path / "run" / "trajectory.npz", 2)
    assert not [name for name in _names(tmp_path / "run") if "mp4" in name]


def test_frames_of_different_sizes_are_no_video(tmp_path):
    files = [tmp_path / "0.png", tmp_path / "1.png"]
    for file, width in zip(files, (16, 32), strict=True):
        iio.imwrite(file, np.zeros((16, width, 3), dtype=np.uint8))
    with pytest.raises(OSError, match=r"out\.mp4: a frame is 32 x 16, the first one is 16 x 16"):
        encode_video(files, tmp_path / "out.mp4", 10.0)
    assert _names(tmp_path) == ["0.png", "1.png"]


# ---- in the background


LONG = 60  # s; only a test that fails waits so long


def _grey(k):
    return torch.full((16, 16, 3), 50 * k / 255)


def _levels(folder):
    return [round(float(frame.mean()) / 50) for frame in iio.imread(folder / "video.mp4")]


def _not_again(monkeypatch):
    monkeypatch.setattr(recorder_module, "encode_video", lambda *_: pytest.fail("the video was encoded again"))


def _before_png(monkeypatch, action):
    write = recorder_module.save_png

    def wrapped(path, *arguments, **settings):
        action(int(path.name.split(".")[1]))
        write(path, *arguments, **settings)

    monkeypatch.setattr(recorder_module, "save_png", wrapped)


def test_the_video_is_in_order_though_the_pngs_are_not(tmp_path, monkeypatch):
    """Frame 0 is compressed after frame 4; the video is encoded while the run goes on, and not a second time."""
    later, finished = threading.Event(), []

    def reverse(frame):
        if frame == 0:
            assert later.wait(LONG)
        finished.append(frame)
        if frame == 4:
            later.set()

    _before_png(monkeypatch, reverse)
    _not_again(monkeypatch)
    recorder = Recorder(trajectory=False)
    recorder.open(tmp_path / "run", real_time_fps=10.0)
    for k in range(5):
        recorder.write_image(k, _grey(k))
    recorder.close(5, {})
    assert finished[-1] == 0
    assert _levels(tmp_path / "run") == [0, 1, 2, 3, 4]
    assert "10 fps" in _probe(tmp_path / "run" / "video.mp4")
    for k in range(5):
        assert (iio.imread(tmp_path / "run" / "frames" / f"{k:05d}.png") == 50 * k).all()


def test_what_is_changed_after_the_call_is_written_as_it_was(tmp_path, monkeypatch):
    gate, save = threading.Event(), torch.save
    _before_png(monkeypatch, lambda _: gate.wait(LONG))

    def check(held, path):
        assert (path.parent / "frames/00000.png").exists()
        assert (path.parent / "trajectory/00000.npz").exists()
        save(held, path)

    monkeypatch.setattr(torch, "save", check)
    recorder = Recorder()
    recorder.open(tmp_path / "run")
    image, position, F, log = _grey(2), torch.ones(4, 3), torch.ones(4, 3, 3).half(), [1]
    try:
        recorder.write_image(0, image)
        recorder.write_trajectory(0, position, F)
        recorder.write_checkpoint({"frame": 0, "state": {"position": position}, "log": log})
        for tensor in (image, position, F):
            tensor.zero_()
        log.append(2)
    finally:
        gate.set()
    recorder.close(1, {})
    assert (iio.imread(tmp_path / "run" / "frames" / "00000.png") == 100).all()
    assert _levels(tmp_path / "run") == [2]
    for stored, shape in zip(load_trajectory(tmp_path / "run" / "trajectory.npz", 0), [(4, 3), (4, 3, 3)], strict=True):
        assert torch.equal(stored, torch.ones(shape))
    checkpoint = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert torch.equal(checkpoint["state"]["position"], torch.ones(4, 3))
    assert checkpoint["log"] == [1]


@pytest.mark.parametrize("frame", [2, 3])
def test_a_run_whose_disk_is_full_can_be_resumed(frame, make_simulation, tmp_path, monkeypatch):
    fail = threading.Event()

    def disk_full(k):
        if k == frame:
            assert k < 3 or fail.wait(LONG)
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        wait = Recorder.wait
        patch.setattr(Recorder, "wait", lambda self: (fail.set() if self._folder else None, wait(self)))
        _before_png(patch, disk_full)
        with pytest.raises(OSError, match=f"frames/0000{frame}.png could not be written: No space left on device"):
            _run(make_simulation(), tmp_path / "run", 4)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["status"] == "failed"
    assert "No space left" in summary["reason"]
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["frame"] < frame
    assert not [name for name in _names(tmp_path / "run") if name.split("/")[-1].startswith(".")]
    _run(make_simulation(), tmp_path / "run", 4, resume=True)
    _run(make_simulation(), tmp_path / "whole", 4)
    videos = [iio.imread(tmp_path / name / "video.mp4") for name in ("run", "whole")]
    assert len(videos[0]) == 4
    assert np.array_equal(*videos)


def test_ffmpeg_that_breaks_off_costs_no_frame(tmp_path, monkeypatch):
    write, calls = VideoEncoder.write, []

    def breaks_off(self, image):
        calls.append(1)
        if len(calls) == 3:
            self._process.kill()
            self._process.wait()
        write(self, image)

    monkeypatch.setattr(VideoEncoder, "write", breaks_off)
    recorder = Recorder(trajectory=False)
    recorder.open(tmp_path / "run")
    for k in range(5):
        recorder.write_image(k, _grey(k))
    recorder.close(5, {})
    assert _levels(tmp_path / "run") == [0, 1, 2, 3, 4]
    assert len(calls) == 10


@pytest.mark.parametrize(
    ("order", "frames", "expected"), [([1, 0, 2], 3, [0, 1, 2]), ([0, 1, 1], 2, [0, 1]), ([0, 1, 2], 2, [0, 1])]
)
def test_the_video_shows_the_frames_that_were_asked_for(order, frames, expected, tmp_path):
    """In whatever order they came, and without one that was begun after the last complete one."""
    recorder = Recorder(trajectory=False)
    recorder.open(tmp_path / "run")
    for k in order:
        recorder.write_image(k, _grey(k))
    recorder.close(frames, {})
    assert _levels(tmp_path / "run") == expected


@pytest.mark.parametrize("how", ["forgotten", "opened again", "closed in vain"])
def test_a_recorder_that_is_not_closed_leaves_its_frames_and_no_process(how, tmp_path):
    recorder = Recorder(trajectory=False)
    recorder.open(tmp_path / "run")
    recorder.write_image(0, _grey(1))
    recorder.wait()
    process = recorder._films["frames"].encoder._process
    assert process.poll() is None
    if how == "forgotten":
        del recorder
        gc.collect()
    elif how == "opened again":
        recorder.open(tmp_path / "other")
    else:
        with pytest.raises(TypeError):
            recorder.close(1, {"a": object()})
    assert process.poll() is not None
    assert _names(tmp_path / "run") == ["frames", "frames/00000.png", "run.json"]


def test_a_program_that_ends_without_closing_loses_no_frame(tmp_path):
    """Nor does it hang, or leave half a video."""
    code = (
        "import threading, torch\n"
        "from gaussian_swaying.recording import recorder as module\n"
        "from gaussian_swaying.recording.recorder import Recorder\n"
        "write = module.save_png\n"
        "module.save_png = lambda *a: (threading.main_thread().join(), write(*a))\n"
        "recorder = Recorder()\n"
        f"recorder.open({str(tmp_path / 'run')!r})\n"
        "for k in range(3): recorder.write_image(k, torch.zeros(16, 16, 3))\n"
        "raise SystemExit(7)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    assert subprocess.run([sys.executable, "-c", code], env=environment, timeout=LONG).returncode == 7
    assert _names(tmp_path / "run" / "frames") == ["00000.png", "00001.png", "00002.png"]
    assert not [name for name in _names(tmp_path / "run") if "mp4" in name]


@pytest.mark.gpu
def test_recording_never_makes_the_host_wait_for_the_gpu(tmp_path):
    """The picture, trajectory and checkpoint are what they were at the call, though all is changed right after it."""
    recorder = Recorder(video=False)
    recorder.open(tmp_path / "run")
    image, position, F = torch.rand(1080, 1920, 3), torch.rand(100_000, 3), torch.rand(100_000, 3, 3)
    on_gpu = [tensor.cuda() for tensor in (image, position, F)]
    torch.cuda.synchronize()
    with without_waits():
        recorder.write_image(0, on_gpu[0])
        recorder.write_trajectory(0, on_gpu[1], on_gpu[2])
        recorder.write_checkpoint({"frame": 0, "state": {"F": on_gpu[2]}})
        for tensor in on_gpu:
            tensor.zero_()
        recorder.wait()
    recorder.close(1, {})
    stored = torch.from_numpy(iio.imread(tmp_path / "run" / "frames" / "00000.png"))
    assert torch.equal(stored, (image * 255 + 0.5).to(torch.uint8))
    found = load_trajectory(tmp_path / "run" / "trajectory.npz", 0)
    assert torch.equal(found[0], position)
    assert torch.equal(found[1], F.half().float())
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["state"]
    assert state["F"].device.type == "cpu"
    assert torch.equal(state["F"], F)


# ---- summary


@pytest.mark.gpu
def test_startup_is_not_counted_as_simulation(make_simulation, tmp_path):
    summary = _run(make_simulation(wind=WindField([6.0, 1.5, 0.0], seed=7)).to("cuda"), tmp_path / "run", 3)
    assert set(summary["wall_s"]) == {"startup", "simulation", "shading", "rendering", "writing"}
    assert summary["wall_s"]["startup"] > 0


def test_the_summary(make_simulation, tmp_path):
    simulation = make_simulation(wind=WindField([6.0, 1.5, 0.0], seed=7))
    returned = _run(simulation, tmp_path / "run", 3, settings={"note": "kept"})
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
    start = simulation.solver.energies(simulation.start())
    state, log = advanced(simulation, 2)
    end = simulation.solver.energies(state)
    for name in ("kinetic", "elastic", "potential"):
        assert summary["energy_start_J"][name] == pytest.approx(float(start[name]), abs=1e-9)
        assert summary["energy_end_J"][name] == pytest.approx(float(end[name]))
    assert summary["substeps"] == sum(health.substeps for health in log)
    assert summary["largest_cfl"] == pytest.approx(max(health.cfl for health in log))
    assert 0.2 < summary["largest_cfl"] <= 0.5
    assert len(summary["per_frame"]) == 3


def test_kernels_are_loaded_without_a_trace(make_simulation, tmp_path):
    """A run that did so first has the frames and the log of one that did not."""
    runs = []
    for load in (False, True):
        simulation = make_simulation(wind=WindField([6.0, 1.5, 0.0], seed=7))
        if load:
            Run(simulation.painter, simulation.editor, simulation.recorder, 3).warm_up(simulation.start(), 0)
        runs.append(_run(simulation, tmp_path / str(load), 3))
    assert runs[0]["per_frame"] == runs[1]["per_frame"]
    for name in ("00000", "00002"):
        one, two = ((tmp_path / str(load) / "frames" / f"{name}.png").read_bytes() for load in (False, True))
        assert one == two


# ---- a run that ends badly


def _fail_at(simulation, monkeypatch, frame, error):
    advance, done = simulation.stepper.advance, []

    def fail(state):
        if len(done) == frame - 1:
            raise error
        done.append(1)
        return advance(state)

    monkeypatch.setattr(simulation.stepper, "advance", fail)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (SimulationDiverged(0.12, 3, "broken", "mend it"), "diverged"),
        (KeyboardInterrupt(), "interrupted"),
        (ValueError("something else"), "failed"),
    ],
)
def test_what_was_recorded_before_the_end_is_kept(error, status, make_simulation, tmp_path, monkeypatch):
    simulation, folder = make_simulation(), tmp_path / "run"
    _fail_at(simulation, monkeypatch, 3, error)
    with pytest.raises(type(error)):
        _run(simulation, folder, 10)
    assert len(list((folder / "frames").glob("*.png"))) == 3
    assert len(iio.imread(folder / "video.mp4")) == 3
    load_trajectory(folder / "trajectory.npz", 2)
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["status"], summary["frames"], summary["frames_wanted"]) == (status, 3, 10)
    assert status == "interrupted" or str(error) == summary["reason"]
    assert not [name for name in _names(folder) if "/." in name or name.startswith(".")]


# ---- films that close


def test_the_end_of_a_motion_becomes_its_beginning(make_simulation, tmp_path):
    """Frames 3 to 9; the last three go over into those before the first; also from the middle of it, resumed."""
    simulation = make_simulation()
    states = [frame.state.node_displacement.clone() for frame in simulation.frames(10)]
    nodes = simulation.scene.follow.nodes(simulation.start())
    for folder, parts in (("whole", [10]), ("first", [2, 10]), ("late", [8, 10])):
        for part in parts:
            if part < 10:
                with pytest.MonkeyPatch.context() as patch:
                    _fail_at(simulation, patch, part, KeyboardInterrupt())
                    with pytest.raises(KeyboardInterrupt):
                        _run(simulation, tmp_path / folder, 10, Recorder(loop=0.12))
            else:
                _run(simulation, tmp_path / folder, 10, Recorder(loop=0.12), resume=len(parts) > 1)
        found = load_nodes(tmp_path / folder / "nodes.npz")
        assert len(found) == len(list((tmp_path / folder / "frames").iterdir())) == 7
        for k in range(7):
            share = max(0, k - 3) / 4
            share *= share * (3 - 2 * share)
            expected = torch.lerp(states[k + 3], states[max(0, k - 4)], share)[nodes]
            torch.testing.assert_close(found[k], expected, rtol=1e-3, atol=1e-6)
    assert (found[6] - found[0]).norm() < 0.4 * (states[9] - states[3])[nodes].norm()
    with value_error(r"resume with the `frames` and the `recorder.loop` of the run"):
        _run(simulation, tmp_path / "whole", 12, Recorder(loop=0.12), resume=True)


def test_what_cannot_close(make_simulation, tmp_path):
    with value_error(r"`frames` to more than 10, or shorten `recorder.loop`"):
        _run(make_simulation(), tmp_path / "run", 10, Recorder(loop=0.2))
    with value_error(r"With `recorder.loop`, `recorder.renders` cannot have force"):
        _run(make_simulation(), tmp_path / "run", 10, Recorder(loop=0.04, renders=("color", "force")))


def test_slow_motion_and_loops_of_the_command_line():
    parser = Simulation.parser()
    plain = parser.parse_args(["--frames=51", "--frame_dt=0.04"])
    found = applied(parser.parse_args(["--frames=51", "--frame_dt=0.04", "--slow=4", "--loop=2"]))
    assert (found.frames, found.frame_dt) == (201 + 50, 0.01)
    assert (found.recorder.fps, found.recorder.loop) == (25.0, 0.5)
    assert applied(plain).recorder == plain.recorder
    assert applied(parser.parse_args(["--loop", "--frames=51"])).recorder.loop == 1.0
    with value_error("`slow` to be positive"):
        applied(parser.parse_args(["--slow=0"]))


# ---- the folder


def test_foreign_files_are_not_overwritten(make_simulation, tmp_path):
    """They bear a name that the run would write, but no run made them."""
    file = tmp_path / "mine/frames/00000.png"
    file.parent.mkdir(parents=True)
    file.write_text("precious")
    with value_error(r"mine contains frames of .* choose another with --output"):
        _run(make_simulation(), tmp_path / "mine", 1)
    assert file.read_text() == "precious"
    assert _names(tmp_path / "mine") == ["frames", "frames/00000.png"]


def test_headers_of_arrays_are_parsed_by_one_thread_at_a_time(tmp_path, monkeypatch):
    """Where two threads parse them at once and the collector runs, Python 3.11 raises a SystemError now and then."""
    (tmp_path / "trajectory.npz").touch()

    class Archive(dict):
        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def __getitem__(self, name):
            assert trajectory._PARSING.locked()
            return np.zeros((5, 3), dtype=np.float32)

    monkeypatch.setattr(trajectory, "check_archive", lambda path, what: path)
    monkeypatch.setattr(np, "load", lambda path: Archive({"position_00000": 0, "F_00000": 0}))
    assert load_trajectory(tmp_path / "trajectory.npz", 0)[0].shape == (5, 3)
