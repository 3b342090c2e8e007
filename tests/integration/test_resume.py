"""Runs that are stopped, killed or broken, and the runs that continue them."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
from shared import refused

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.recording import recorder
from gaussian_swaying.recording.checkpoint import read_checkpoint
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.run import Run

ROOT = Path(__file__).parents[2]
PIN = (
    '[{"class_path": "PinnedRegion", "init_args": {"region": {"class_path": "Box", '
    '"init_args": {"min": [null, null, null], "max": [0.11, null, null]}}}}]'
)
FRAMES = 6


def _arguments(folder, *more):
    common = ["--config", str(ROOT / "configs/sim/flag.yaml"), "--output", str(folder), "--frames", str(FRAMES)]
    common += ["--device", "cpu", "--scene.generator.init_args.spacing", "0.1", "--solver.dx", "0.2"]
    common += ["--solver.boundaries", PIN, "--camera.init_args.width", "32", "--camera.init_args.height", "18"]
    return [*common, *more]


def _trajectory(folder):
    return [load_trajectory(folder / "trajectory.npz", frame) for frame in range(FRAMES)]


def _stop_after(monkeypatch, frames, error=KeyboardInterrupt):
    """Break the run while it records the given frame."""
    record = Run.record

    def stop(self, state, frame):
        if frame == frames:
            raise error("stopped")
        record(self, state, frame)

    monkeypatch.setattr(Run, "record", stop)


def _same_as_uninterrupted(folder, other):
    for (position, F), (expected, expected_F) in zip(_trajectory(folder), _trajectory(other), strict=True):
        assert torch.equal(position, expected)
        assert torch.equal(F, expected_F)
    for frame in range(FRAMES):
        name = f"frames/{frame:05d}.png"
        assert (folder / name).read_bytes() == (other / name).read_bytes()
    assert len(iio.imread(folder / "video.mp4")) == FRAMES
    mine, others = (json.loads((path / "summary.json").read_text()) for path in (folder, other))
    assert mine["status"] == "complete"
    for name in ("per_frame", "energy_start_J", "energy_end_J", "largest_cfl", "substeps", "frames", "simulated_s"):
        assert mine[name] == others[name], name
    states = [torch.load(path / "checkpoint.pt", weights_only=True)["state"] for path in (folder, other)]
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]) if isinstance(value, torch.Tensor) else value == states[1][name]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run from start to end."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main(_arguments(folder)) == 0
    return folder


def test_a_stopped_run_continues_bit_for_bit(tmp_path, monkeypatch, capsys):
    """From a checkpoint that is older than the last frame."""
    more = ["--solver.formulation", "updated", "--recorder.checkpoint_every", "2"]
    folder, other = tmp_path / "run", tmp_path / "whole"
    assert main(_arguments(other, *more)) == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, 3)
        assert main(_arguments(folder, *more)) == 130
    assert "--resume" in capsys.readouterr().err
    assert json.loads((folder / "summary.json").read_text())["status"] == "interrupted"
    assert main(_arguments(folder, "--resume", *more)) == 0
    _same_as_uninterrupted(folder, other)


def test_a_killed_run_continues_bit_for_bit(whole, tmp_path):
    """SIGKILL in the middle: no handler runs, nothing is packed; a half-written file lies about."""
    folder = tmp_path / "run"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    # the same program, slowed down so that the kill surely comes in the middle
    code = (
        "import sys, time\n"
        "from gaussian_swaying.cli import simulate\n"
        "from gaussian_swaying.simulation import stepper\n"
        "advance = stepper.Stepper.advance\n"
        "def slow(self, state):\n"
        "    time.sleep(60 if float(state.time) > 0.1 else 0)\n"
        "    return advance(self, state)\n"
        "stepper.Stepper.advance = slow\n"
        "sys.exit(simulate.main(sys.argv[1:]))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, *_arguments(folder)], env=environment, stdout=subprocess.DEVNULL
    )
    try:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and process.poll() is None:
            checkpoint = folder / "checkpoint.pt"
            if checkpoint.exists() and torch.load(checkpoint, weights_only=True)["frame"] == 3:
                break
            time.sleep(0.05)
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert not (folder / "summary.json").exists()
    (folder / "trajectory" / ".00004.gs-writing-1234.npz").write_bytes(b"half")
    (folder / ".my.notes.txt").write_text("precious")
    (folder / "frames" / ".a.b.c").write_text("precious")
    assert main(_arguments(folder, "--resume")) == 0
    assert (folder / ".my.notes.txt").read_text() == "precious"
    assert sorted(path.name for path in folder.rglob(".*")) == [".a.b.c", ".my.notes.txt"]
    (folder / "frames" / ".a.b.c").unlink()
    _same_as_uninterrupted(folder, whole)


@pytest.mark.slow(gate=["SIGTERM"])
@pytest.mark.skipif(os.name == "nt", reason="sends SIGTERM")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_run_that_is_told_to_end(name, whole, tmp_path, capsys):
    """It holds its folder while it lives; then it ends in order, with its video, and names the command to go on."""
    folder, slow = tmp_path / "run", tmp_path / "slow"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    code = (
        "import pathlib, signal, sys, time\n"
        "from gaussian_swaying.cli import simulate\n"
        "from gaussian_swaying.simulation import stepper\n"
        f"signal.signal(signal.{name}, signal.SIG_DFL)\n"
        "advance = stepper.Stepper.advance\n"
        "def slow(self, state):\n"
        "    if float(state.time) > 0.1:\n"
        f"        pathlib.Path({str(slow)!r}).touch()\n"
        "        while True: time.sleep(0.05)\n"
        "    return advance(self, state)\n"
        "stepper.Stepper.advance = slow\n"
        "sys.exit(simulate.main(sys.argv[1:]))\n"
    )
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", code, *_arguments(folder)], env=environment, **pipes)
    try:
        deadline = time.monotonic() + 120
        while not slow.exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        assert slow.exists()
        while time.monotonic() < deadline:  # written in the background, after the frame
            if (folder / "checkpoint.pt").exists() and read_checkpoint(folder / "checkpoint.pt")["frame"] == 3:
                break
            time.sleep(0.05)
        for more in ([], ["--resume"]):
            refused(
                main,
                _arguments(folder, *more),
                capsys,
                f"process {process.pid} on this host",
                "stop it",
                folder=tmp_path,
            )
        process.send_signal(getattr(signal, name))
        error = process.communicate(timeout=120)[1]
        assert process.returncode == 128 + getattr(signal, name)
    finally:
        process.kill()
        process.wait()
    assert "Traceback" not in error
    assert f"{folder}/checkpoint.pt contains the run up to frame 3; to continue:\n" in error
    assert error.endswith(" --resume\n")
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["status"], summary["reason"]) == ("interrupted", f"stopped by {name}")
    assert summary["frames"] == 4
    assert len(iio.imread(folder / "video.mp4")) == 4
    assert not [path for path in folder.rglob(".*")]
    assert main(_arguments(folder, "--resume")) == 0
    _same_as_uninterrupted(folder, whole)


@pytest.mark.skipif(os.name == "nt", reason="sends SIGINT")
def test_ctrl_c_while_the_queue_is_full(whole, tmp_path):
    """The disk hangs, the run waits for it and is stopped: it ends in order, with the frames and video so far."""
    folder, full, told, go_on = (tmp_path / name for name in ("run", "full", "told", "go_on"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    code = (
        "import functools, pathlib, signal, sys, time\n"
        # ignored where a script starts the tests in the background
        "def stop(*given):\n"
        "    told.touch()\n"
        "    signal.default_int_handler(*given)\n"
        "signal.signal(signal.SIGINT, stop)\n"
        "from gaussian_swaying.cli import simulate\n"
        "from gaussian_swaying.recording import recorder\n"
        f"full, told, go_on = (pathlib.Path({str(tmp_path)!r}) / name for name in ('full', 'told', 'go_on'))\n"
        "class Writer(recorder.FrameWriter):\n"
        "    def submit(self, *arguments, **settings):\n"
        "        if self.pending == self.limit: full.touch()\n"
        "        super().submit(*arguments, **settings)\n"
        "recorder.FrameWriter = functools.partial(Writer, limit=8)\n"
        "write = recorder.save_png\n"
        "def hang(path, *arguments, **settings):\n"
        "    while not go_on.exists(): time.sleep(0.01)\n"
        "    write(path, *arguments, **settings)\n"
        "recorder.save_png = hang\n"
        "sys.exit(simulate.main(sys.argv[1:]))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, *_arguments(folder)], env=environment, stdout=subprocess.DEVNULL
    )
    try:
        deadline = time.monotonic() + 120
        while not full.exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        assert full.exists()
        process.send_signal(signal.SIGINT)
        while not told.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert told.exists()
        assert process.poll() is None  # what is in the queue is not dropped
        go_on.touch()
        assert process.wait(120) == 130
    finally:
        process.kill()
        process.wait()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert 0 < summary["frames"] < FRAMES
    assert len(iio.imread(folder / "video.mp4")) == summary["frames"]
    assert torch.load(folder / "checkpoint.pt", weights_only=True)["frame"] == summary["frames"] - 1
    assert not [path for path in folder.rglob(".*")]
    assert main(_arguments(folder, "--resume")) == 0
    _same_as_uninterrupted(folder, whole)


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """A run that was stopped after two frames."""
    with monkeypatch.context() as patch:
        _stop_after(patch, 2)
        assert main(_arguments(tmp_path / "run")) == 130
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--material.E", "5000"], ["`material.E` was", "now 5000.0"]),
        (["--wind.seed", "3"], ["`wind.seed` was 0, now 3"]),
        (["--shader", "null"], ["`shader"]),
        (["--material.regions", '[{"region": {"class_path": "Everything"}, "E": 1.0}]'], ["`material.regions"]),
    ],
)
def test_another_configuration_is_refused_by_name(change, words, stopped, capsys):
    arguments = _arguments(stopped, "--resume", *change)
    refused(main, arguments, capsys, "configuration differs", "--resume", *words, folder=stopped)


def test_the_end_of_a_run_names_its_checkpoint(tmp_path, monkeypatch, capsys):
    """After a failure with the command, after a divergence without, as it would diverge again; a refusal names none."""
    folder = tmp_path / "run"
    for frame, error, words in (
        (0, OSError("the disk is full"), None),
        (2, OSError("the disk is full"), "frame 1; to continue:\n  python tools/sim.py --config"),
        (3, SimulationDiverged(0.12, 0, "broken", "mend it"), "frame 2; continuing from it would diverge again"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["tools/sim.py"])
            _stop_after(patch, frame, lambda _, error=error: error)
            assert main(_arguments(folder)) == 2
        said = capsys.readouterr().err
        assert said.count("checkpoint.pt contains") == (words is not None)
        assert words is None or words in said
        assert ("error: the disk is full" if frame < 3 else "mend it") in said
    assert main(_arguments(folder, "--frames", "1", "--resume")) == 2
    assert "checkpoint.pt contains" not in capsys.readouterr().err


def test_nothing_to_resume(tmp_path, capsys):
    refused(
        main, _arguments(tmp_path / "none", "--resume"), capsys, "nothing to resume", "checkpoint.pt", folder=tmp_path
    )
    assert not (tmp_path / "none").exists()


def test_a_refused_run_does_not_move_the_earlier_one(stopped, capsys):
    refused(main, _arguments(stopped, "--wind.flow", "[1, 2]"), capsys, "flow", folder=stopped)
    assert [path.name for path in stopped.parent.iterdir()] == [stopped.name]


def test_checkpoints_are_written_after_what_they_promise(tmp_path, monkeypatch):
    """A checkpoint of frame k exists only once the picture and the trajectory of frame k do, however slow they are."""
    seen, queued = [], threading.Semaphore(0)
    save, write = torch.save, recorder.save_png

    class Writer(recorder.FrameWriter):
        def submit(self, name, *arguments, **settings):
            super().submit(name, *arguments, **settings)
            if "checkpoint" in name:
                queued.release()

    def check(checkpoint, path):
        for frame in range(checkpoint["frame"] + 1):
            assert (path.parent / "frames" / f"{frame:05d}.png").exists()
            assert (path.parent / "trajectory" / f"{frame:05d}.npz").exists()
        seen.append(checkpoint["frame"])
        save(checkpoint, path)

    def late(*arguments, **settings):
        assert queued.acquire(timeout=60)  # the checkpoint of its frame waits already
        write(*arguments, **settings)

    monkeypatch.setattr(torch, "save", check)
    monkeypatch.setattr(recorder, "save_png", late)
    monkeypatch.setattr(recorder, "FrameWriter", Writer)
    assert main(_arguments(tmp_path / "run")) == 0
    assert seen == list(range(FRAMES))
