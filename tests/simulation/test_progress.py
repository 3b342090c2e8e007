"""What a run shows: frames, progress within one that is slow, and why it is."""

from pathlib import Path

import pytest
import torch
from shared import SMALL, in_both, refused, words

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation import measure, step
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.measure import RunProgress
from gaussian_swaying.simulation.record import MAX_LOOKS

FLAG = Path(__file__).parents[2] / "configs/sim/flag.yaml"
RUN = [f"--config={FLAG}", "--device=cpu", *words(SMALL | {"solver.boundaries": [], "material.E": 9e3, "frames": 3})]


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 0.0

    monkeypatch.setattr(measure.time, "perf_counter", lambda: Clock.now)
    return Clock


def work(progress, clock, frame, steps, seconds):
    """A frame of so many substeps of so many seconds each."""
    progress.begin(frame)
    for done in range(1, steps + 1):
        clock.now += seconds
        progress.substep(done, steps)
    progress.end(steps, 0.125)


def test_usual_frames_say_nothing_but_where_they_are(clock, capsys):
    progress = RunProgress(4)
    for frame in range(4):
        work(progress, clock, frame, 50, 0.01)
    progress.close()
    said = capsys.readouterr().err
    assert "50 substeps, 0.125 m from rest on average" in said
    assert "note:" not in said
    assert "left in this frame" not in said


def test_a_slow_frame_shows_its_substeps_and_says_why_once(clock, capsys):
    progress = RunProgress(10)
    work(progress, clock, 1, 10, 0.5)
    said = capsys.readouterr().err
    assert "substep 3 of 10, 3.5 s left in this frame" in said
    assert "note:" not in said
    work(progress, clock, 2, 300, 0.5)
    work(progress, clock, 3, 400, 0.5)
    said = capsys.readouterr().err
    assert said.count("note:") == 1
    assert "note: Frame 2 takes 300 substeps, about 2.5 min, 30 times those of the first" in said
    work(progress, clock, 4, 1300, 0.5)
    assert "note: Frame 4 takes 1,300 substeps" in capsys.readouterr().err
    progress.close()


def test_a_slow_first_frame_is_told_with_the_whole_run(clock, capsys):
    progress = RunProgress(101)
    work(progress, clock, 1, 1000, 0.1)
    said = capsys.readouterr().err
    assert said.count("note:") == 1
    assert "note: Frame 1 takes 1,000 substeps, about 100 s, and the remaining frames about 2.8 h." in said
    assert "`solver.dx`" in said


def test_a_frame_that_is_done_again_is_counted_anew(clock, capsys):
    progress = RunProgress(10)
    progress.begin(1)
    for steps in (20, 40):
        for done in range(1, steps + 1):
            clock.now += 1.0
            progress.substep(done, steps)
    assert "substep 40 of 40, 0 ms left" in capsys.readouterr().err


@in_both
@pytest.mark.parametrize("looks", [1, 8])
def test_watching_changes_no_bit(formulation, looks):
    solver = MPMSolver(0.25, formulation, transfer="torch")
    points = MaterialPoints.create(
        torch.rand(200, 3), volume=1e-3, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3
    )
    state, told = solver.init_state(points), []
    plain, speed = solver.watched_rollout(state, 1e-4, 21, looks=looks)
    watched, same = solver.watched_rollout(state, 1e-4, 21, looks=looks, watch=told.append)
    assert told == list(range(1, 22))
    assert torch.equal(plain.position, watched.position)
    assert torch.equal(plain.velocity, watched.velocity)
    assert torch.equal(speed, same)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--solver.substep", "1e-9"], ["40,000,000 substeps", "raise `solver.substep`"]),
        (["--material.E", "1e16"], ["substeps", "`material.E`", "`frame_dt`"]),
        (
            ["--camera.init_args.width", "60000", "--camera.init_args.height", "60000"],
            ["60,000 x 60,000 pixels is too"],
        ),
        (["--scene.generator.init_args.spacing", "1e-9"], ["`generator.spacing` that makes at most"]),
        (["--background", "[255, 255, 255]"], ["`background` within [0, 1]"]),
        (["--background", "[-0.1, 0, 0]"], ["`background` within [0, 1]"]),
    ],
)
def test_what_has_no_end_or_place_is_refused(arguments, words, tmp_path, capsys):
    """Substeps without end, pictures and scenes for which there is no memory, colours beyond white."""
    refused(main, [*RUN, *arguments, "--output", str(tmp_path / "run")], capsys, *words, folder=tmp_path)


def test_a_frame_that_gets_too_many_substeps_ends_the_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(step, "MAX_SUBSTEPS", 20)
    assert main([*RUN, "--wind.flow", "[300, 0, 0]", "--output", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "substeps, more than the limit of 20" in said
    assert (tmp_path / "run/frames/00000.png").exists()


def test_the_cameras_of_as_many_frames_as_there_may_be(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(Painter, "check_camera", lambda self, frame: seen.append(frame))

    def stop(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(step.Stepper, "start", stop)
    assert main([*RUN, "--frames", "10000000", "--output", str(tmp_path / "run")]) == 130
    assert len(seen) == MAX_LOOKS
    assert (seen[0], seen[-1]) == (0, 9_999_999)
    seen.clear()
    assert main([*RUN, "--frames", "7", "--output", str(tmp_path / "run")]) == 130
    assert seen == list(range(7))
