"""Runs that are stopped, killed or broken, and the runs that continue them."""

import json
import os
import shutil
import signal
import sys
import threading

import imageio.v3 as iio
import pytest
import torch
from shared import SMALL, refused, words

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.recording import recorder
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.simulation.measure import SimulationDiverged
from gaussian_swaying.simulation.record import Run

FRAMES = 6


def _arguments(folder, *more):
    common = ["--config=flag", f"--output={folder}", f"--frames={FRAMES}", "--device=cpu", *words(SMALL)]
    return [*common, *more]


def _at(monkeypatch, frame, act):
    record = Run.record

    def acting(self, state, number):
        if number == frame:
            act(self)
        record(self, state, number)

    monkeypatch.setattr(Run, "record", acting)


def _raising(error):
    def act(run):
        raise error

    return act


def _same_as_uninterrupted(folder, other):
    for frame in range(FRAMES):
        found, expected = (load_trajectory(path / "trajectory.npz", frame) for path in (folder, other))
        assert all(map(torch.equal, found, expected))
        name = f"frames/{frame:05d}.png"
        assert (folder / name).read_bytes() == (other / name).read_bytes()
    assert len(iio.imread(folder / "video.mp4")) == FRAMES
    mine, others = (json.loads((path / "summary.json").read_text()) for path in (folder, other))
    assert mine["status"] == "complete"
    for name in ("per_frame", "energy_start_J", "energy_end_J", "largest_cfl", "substeps", "frames", "simulated_s"):
        assert mine[name] == others[name], name


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main(_arguments(folder)) == 0
    return folder


def test_a_stopped_run_continues_bit_for_bit(tmp_path, monkeypatch, capsys):
    more = ["--solver.formulation=updated", "--recorder.checkpoint_every=2"]
    folder, other = tmp_path / "run", tmp_path / "whole"
    assert main(_arguments(other, *more)) == 0
    with monkeypatch.context() as patch:
        _at(patch, 3, _raising(KeyboardInterrupt))
        assert main(_arguments(folder, *more)) == 130
    assert "--resume" in capsys.readouterr().err
    assert json.loads((folder / "summary.json").read_text())["status"] == "interrupted"
    assert main(_arguments(folder, "--resume", *more)) == 0
    _same_as_uninterrupted(folder, other)


def test_a_killed_run_continues_bit_for_bit(whole, tmp_path, monkeypatch):
    """It leaves no summary, nothing that is packed, and a half-written file."""
    folder = tmp_path / "run"

    def leave(run):
        run.recorder.wait()
        shutil.copytree(run.recorder.folder, folder)

    with monkeypatch.context() as patch:
        _at(patch, 4, leave)
        assert main(_arguments(tmp_path / "goes on")) == 0
    assert not (folder / "summary.json").exists()
    (folder / "trajectory" / ".00004.gs-writing-1234.npz").write_bytes(b"half")
    for name in (".my.notes.txt", "frames/.a.b.c"):
        (folder / name).write_text("precious")
    assert main(_arguments(folder, "--resume")) == 0
    assert sorted(path.name for path in folder.rglob(".*")) == [".a.b.c", ".my.notes.txt"]
    _same_as_uninterrupted(folder, whole)


@pytest.mark.skipif(os.name == "nt", reason="sends SIGTERM")
@pytest.mark.usefixtures("default_signals")
def test_a_run_that_is_told_to_end(whole, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"

    def end(run):
        run.recorder.wait()
        for more in ([], ["--resume"]):
            refused(main, _arguments(folder, *more), capsys, f"process {os.getpid()} on this host")
        os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        _at(patch, 4, end)
        assert main(_arguments(folder)) == 143
    error = capsys.readouterr().err
    assert f"{folder}/checkpoint.pt contains the run up to frame 3; to continue:\n" in error
    assert error.endswith(" --resume\n")
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["status"], summary["reason"], summary["frames"]) == ("interrupted", "stopped by SIGTERM", 4)
    assert len(iio.imread(folder / "video.mp4")) == 4
    assert not [path for path in folder.rglob(".*")]
    assert main(_arguments(folder, "--resume")) == 0
    _same_as_uninterrupted(folder, whole)


def test_ctrl_c_while_frames_wait_for_the_disk(tmp_path, monkeypatch):
    ends, write, close = threading.Event(), recorder.save_png, recorder.Recorder.close
    monkeypatch.setattr(recorder, "save_png", lambda *given: (ends.wait(60), write(*given)))
    monkeypatch.setattr(recorder.Recorder, "close", lambda *given, **more: (ends.set(), close(*given, **more))[1])
    _at(monkeypatch, 1, _raising(KeyboardInterrupt))
    assert main(_arguments(tmp_path)) == 130
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 1
    assert len(iio.imread(tmp_path / "video.mp4")) == 1
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["frame"] == 0


def test_what_does_not_go_on_changes_nothing(tmp_path, monkeypatch, capsys):
    """Another configuration is refused by the name of a field; a run that is refused does not move the earlier one."""
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        _at(patch, 2, _raising(KeyboardInterrupt))
        assert main(_arguments(folder)) == 130
    region = '[{"region": {"class_path": "Everything"}, "E": 1.0}]'
    for place, more, told in (
        (folder, ["--resume", "--material.E=5000"], ["configuration differs", "`material.E` was", "now 5000.0"]),
        (folder, ["--resume", "--wind.seed=3"], ["`wind.seed` was 0, now 3"]),
        (folder, ["--resume", "--shader=null"], ["`shader"]),
        (folder, ["--resume", f"--material.regions={region}"], ["`material.regions"]),
        (folder, ["--resume", "--frames=1"], ["`frames`"]),
        (folder, ["--wind.flow=[1, 2]"], ["flow"]),
        (tmp_path / "none", ["--resume"], ["nothing to resume", "checkpoint.pt"]),
    ):
        refused(main, _arguments(place, *more), capsys, *told, folder=tmp_path)


def test_the_end_of_a_run_names_its_checkpoint(tmp_path, monkeypatch, capsys):
    """After a failure with the command, after a divergence without, as it would diverge again."""
    monkeypatch.setattr(sys, "argv", ["tools/sim.py"])
    for frame, error, told in (
        (0, OSError("the disk is full"), None),
        (2, OSError("the disk is full"), "frame 1; to continue:\n  python tools/sim.py --config"),
        (3, SimulationDiverged(0.12, 0, "broken", "mend it"), "frame 2; continuing from it would diverge again"),
    ):
        with monkeypatch.context() as patch:
            _at(patch, frame, _raising(error))
            assert main(_arguments(tmp_path / "run")) == 2
        said = capsys.readouterr().err
        assert said.count("checkpoint.pt contains") == (told is not None)
        assert told is None or told in said
        assert f"error: {error}" in said
