import errno
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
from loky import ProcessPoolExecutor
from PIL import Image
from shared import refused, rows

from gaussian_swaying.cli.sweep import explain, main
from gaussian_swaying.runs.lock import LOCK, FolderLock
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps import run
from gaussian_swaying.sweeps.plan import parse_run, read_sweep
from gaussian_swaying.sweeps.run import Job, Outcome, drive, work

QUICK = ["--workers", "2", "--device", "cpu"]


def _done(folder):
    return {file: file.stat().st_mtime_ns for file in (folder / "results").glob("[0-9]*.json")}


def _attempts(folder):
    return [json.loads(file.read_text())["attempts"] for file in sorted((folder / "results").iterdir())]


def _same_motion(one, two, name):
    with np.load(one / "runs" / name / "trajectory.npz") as a, np.load(two / "runs" / name / "trajectory.npz") as b:
        assert a.files == b.files
        assert all(np.array_equal(a[entry], b[entry]) for entry in a.files)


# ---- what a sweep writes


def test_a_sweep(undisturbed):
    table = rows(undisturbed / "sweep.csv")
    assert [row["run"] for row in table] == [f"{number:05d}" for number in range(8)]
    assert {row["status"] for row in table} == {"complete"}
    assert [json.loads(row["wind.flow"])[0] for row in table] == [4.0] * 4 + [8.0] * 4
    assert len({row["wind_work_J"] for row in table}) == 8
    for row in table:
        summary = json.loads((undisturbed / "runs" / row["run"] / "summary.json").read_text())
        assert summary["status"] == "complete"
        assert summary["sweep"]["settings"]["wind.seed"] == int(row["wind.seed"]) == summary["seed"]
        assert float(row["displacement_mean_max_m"]) == summary["displacement_mean_max_m"]
        assert float(row["kinetic_end_J"]) == summary["energy_end_J"]["kinetic"]
        assert int(row["frames"]) == 12
        assert (undisturbed / "runs" / row["run"] / "video.mp4").exists()
    assert not [name for name in table[0] if "wall" in name or "time" in name]
    assert _attempts(undisturbed) == [1] * 8
    assert json.loads((undisturbed / "results/00003.json").read_text())["wall_s"]["simulation"] > 0
    assert not (undisturbed / LOCK).exists()


def test_a_run_of_a_sweep_is_that_of_sim(undisturbed, tmp_path):
    """Its stored configuration, run alone in this process, moves to the same bits."""
    name = "00005"
    stored = undisturbed / "runs" / name / "config.yaml"
    Simulation.from_yaml(stored, device="cpu").run(tmp_path / "runs" / name, frames=12, progress=False)
    _same_motion(undisturbed, tmp_path, name)


def test_the_contact_sheet_shows_every_run(undisturbed):
    with Image.open(undisturbed / "contact_sheet.png") as sheet:
        pixels = np.asarray(sheet.convert("RGB"))
    sky = (np.abs(pixels.astype(int) - [140, 173, 204]).max(-1) < 3).sum()
    assert sky > 8 * 240 * 135 / 4
    assert pixels.shape[0] > 2 * 135


def test_a_complete_sweep_is_left_alone(undisturbed, tmp_path, sweep_file, capsys):
    before, table = _done(undisturbed), (undisturbed / "sweep.csv").read_bytes()
    file = sweep_file(tmp_path / "tiny.yaml")
    assert main([str(file), "--output", str(undisturbed), "--resume"]) == 0
    assert "8 runs: 8 complete" in capsys.readouterr().out
    assert _done(undisturbed) == before
    assert (undisturbed / "sweep.csv").read_bytes() == table


# ---- disturbed sweeps


def test_killed_workers_change_nothing(undisturbed, tmp_path, sweep_file, kill):
    kill(3)
    assert main([str(sweep_file(tmp_path / "tiny.yaml")), "--output", str(tmp_path / "out"), *QUICK]) == 0
    assert sum(_attempts(tmp_path / "out")) == 11
    assert (tmp_path / "out/sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()
    for number in range(8):
        _same_motion(undisturbed, tmp_path / "out", f"{number:05d}")


def test_a_run_goes_on_where_its_worker_was_killed(undisturbed, tmp_path, sweep_file):
    plan, parser = read_sweep(sweep_file(tmp_path / "tiny.yaml")), Simulation.parser()
    for place in ("runs", "results", "logs"):
        (tmp_path / place).mkdir()
    begun = Simulation.from_settings(parser, parse_run(parser, plan.config, 5, plan.runs[5]))
    begun.run(tmp_path / "runs/00005", 5, progress=False)
    job = Job(tmp_path, ("00005",), plan.config, plan.frames, (plan.runs[5],), "cpu", attempt=2)
    result = work(job, 1, explain).results["00005"]
    assert (result["status"], result["attempts"], result["figures"]["frames"]) == ("complete", 2, 12)
    _same_motion(undisturbed, tmp_path, "00005")
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["00005"]  # no earlier run was moved aside


@pytest.mark.usefixtures("default_signals")
def test_a_stopped_sweep_ends_in_order(undisturbed, tmp_path, sweep_file, monkeypatch, capsys):
    file, folder, outcome = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out", run.Processes.outcome

    def stop(self, job, future):
        found = outcome(self, job, future)
        os.kill(os.getpid(), signal.SIGTERM)
        return found

    with monkeypatch.context() as patch:
        patch.setattr(run.Processes, "outcome", stop)
        patch.setattr(run, "STOP_S", 60.0)  # a worker that has not ended by then is killed, as it would be later
        assert main([str(file), "--output", str(folder), *QUICK]) == 143
    error = capsys.readouterr().err
    assert "Stopped; complete runs are kept" in error
    assert "--resume" in error
    assert "Traceback" not in error
    assert list(folder.rglob(LOCK)) == []
    table = rows(folder / "sweep.csv")
    assert {row["run"] for row in table if row["status"] == "complete"} == {path.stem for path in _done(folder)}
    assert {row["status"] for row in table} == {"complete", "missing"}
    begun = len(_done(folder))
    assert main([str(file), "--output", str(folder), *QUICK, "--resume"]) == 0
    assert f" {begun}/8 " in capsys.readouterr().err
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()


def test_ctrl_c_of_the_terminal_is_for_the_driver_alone(tmp_path, sweep_file, monkeypatch):
    submit = run.Processes.submit

    def disturbed(self, job):
        future = submit(self, job)
        (process,) = self._executors[self._places[future]]._processes.values()
        os.kill(process.pid, signal.SIGINT)
        return future

    monkeypatch.setattr(run, "ProcessPoolExecutor", ProcessPoolExecutor)  # as outside the tests
    monkeypatch.setattr(run.Processes, "submit", disturbed)
    file = sweep_file(tmp_path / "one.yaml", {"wind.seed": [1]}, 1, {"frames": 2})
    assert main([str(file), "--output", str(tmp_path / "out"), *QUICK]) == 0
    assert _attempts(tmp_path / "out") == [1]


ORPHAN = """
import os, sys, time
from gaussian_swaying.sweeps.run import _end_with_parent
if os.fork() == 0:
    _end_with_parent()
    open(sys.argv[1], "w").write(str(os.getpid()))
    time.sleep(100)
while not os.path.exists(sys.argv[1]) or not os.path.getsize(sys.argv[1]):
    time.sleep(0.1)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
def test_a_worker_with_nothing_to_do_ends_with_its_driver(tmp_path):
    subprocess.run([sys.executable, "-c", ORPHAN, tmp_path / "pid"], check=True, cwd=Path(__file__).parents[2])
    stat, end = Path("/proc") / (tmp_path / "pid").read_text() / "stat", time.monotonic() + 60
    while stat.exists() and ") Z " not in stat.read_text():
        assert time.monotonic() < end
        time.sleep(0.2)


# ---- failures


def test_failed_runs_are_recorded_and_stop_nothing(tmp_path, sweep_file, capsys):
    axes = {"wind.flow": [[4.0, 1.0, 0.0], [9e3, 0.0, 0.0]], "material.nu": [0.3, 0.5]}
    file, folder = sweep_file(tmp_path / "bad.yaml", axes, 1, {"frames": 4}), tmp_path / "out"
    assert main([str(file), "--output", str(folder), *QUICK]) == 2
    told = capsys.readouterr()
    assert "4 runs: 1 complete, 1 diverged, 2 failed" in told.out
    assert "error: 3 of 4 runs failed" in told.err
    assert "Traceback" not in told.err
    table = rows(folder / "sweep.csv")
    assert [row["status"] for row in table] == ["complete", "failed", "diverged", "failed"]
    assert "`material.nu`" in table[1]["reason"]
    assert "wind" in table[2]["reason"]
    assert _attempts(folder) == [1, 2, 2, 2]
    assert (folder / "contact_sheet.png").exists()
    before = _done(folder)
    assert main([str(file), "--output", str(folder), *QUICK, "--resume"]) == 2
    after = _done(folder)
    assert [path.stem for path in sorted(before) if after[path] == before[path]] == ["00000"]  # others are tried again
    assert rows(folder / "sweep.csv") == table


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "frames/00003.png"), ("frames/00003.png", "make room")),
        (MemoryError(), ("not enough memory", "--workers")),
        (ZeroDivisionError("division by zero"), ("division by zero",)),
        (AssertionError("odd"), ("AssertionError: odd", "logs")),
    ],
)
def test_what_failed_is_told_in_one_sentence(tmp_path, monkeypatch, error, words):
    def fail(job):
        raise error

    monkeypatch.setattr(run, "run_alone", fail)
    (tmp_path / "logs").mkdir()
    done = work(Job(tmp_path, ("00000",), "", 2, ({},), attempt=2), 1, explain)
    result = done.results["00000"]
    assert (result["status"], result["attempts"], done.ready) == ("failed", 2, False)
    for word in words:
        assert word in result["reason"]
    assert "\n" not in result["reason"]
    assert "Traceback" in (tmp_path / "logs/00000.txt").read_text()


def test_a_run_whose_process_is_killed_too_often_is_recorded(tmp_path, sweep_file, kill, capsys):
    file, folder = sweep_file(tmp_path / "two.yaml", {"wind.seed": [1, 2]}, 1, {"frames": 2}), tmp_path / "out"
    kill(1)
    assert main([str(file), "--output", str(folder), *QUICK, "--retries", "0"]) == 2
    assert "run 00000 failed" in capsys.readouterr().err
    bad, good = rows(folder / "sweep.csv")
    assert (bad["status"], good["status"]) == ("failed", "complete")
    assert "SIGKILL" in bad["reason"]
    assert "--workers" in bad["reason"]
    assert main([str(file), "--output", str(folder), *QUICK, "--resume"]) == 0


class _Scripted:
    """A pool that ends jobs as it is told."""

    workers = 1

    def __init__(self, ends):
        self.ends, self.given, self.closed = list(ends), [], False

    def submit(self, job):
        self.given.append(job)
        future = Future()
        future.set_result(None)
        return future

    def outcome(self, job, future):
        status, killed = self.ends.pop(0)
        return Outcome({name: {"status": status} for name in job.wanted}, killed)

    def close(self, stopped=False):
        assert not stopped
        self.closed = True


def _drive(job, ends, retries=1):
    pool, found = _Scripted(ends), {}
    drive([job], pool, lambda name, result: found.update({name: result["status"]}), retries)
    assert pool.closed
    assert pool.ends == []
    return pool, found


def test_what_is_tried_again(tmp_path):
    one = Job(tmp_path, ("00000",), "", 2, ({},))
    bad, killed, good = ("failed", False), ("failed", True), ("complete", False)
    pool, found = _drive(one, [bad, good])
    assert found == {"00000": "complete"}
    assert [job.attempt for job in pool.given] == [1, 2]
    assert _drive(one, [bad, bad])[1] == {"00000": "failed"}
    assert _drive(one, [killed] * 3 + [good])[1] == {"00000": "complete"}
    assert _drive(one, [killed] * 4)[1] == {"00000": "failed"}
    many = Job(tmp_path, ("00000", "00001", "00002"), "", 2, ({}, {}, {}), complete=frozenset({"00001"}))
    pool, found = _drive(many, [bad, good, bad, good])
    assert found == {"00000": "complete", "00002": "complete"}
    assert [job.names for job in pool.given] == [many.names, ("00000",), ("00002",), ("00002",)]
    pool, found = _drive(many, [killed, good])
    assert [job.names for job in pool.given] == [many.names] * 2
    assert found == {"00000": "complete", "00002": "complete"}


# ---- refused


def test_what_is_refused_changes_nothing(undisturbed, tmp_path, sweep_file, capsys):
    before = {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")}
    (tmp_path / "mine/runs").mkdir(parents=True)
    (tmp_path / "text").write_text("")
    resumed, new = [undisturbed, "--resume"], {"settings": {"material.density": 40.0}}
    for fields, (output, *more), told in (
        ({}, [undisturbed], ["holds a sweep already", "--resume", "--output"]),
        (new, resumed, ["other settings", "material.density", "30.0", "40.0"]),
        ({"seed": 1}, resumed, ["other settings", "wind.seed"]),
        ({"draws": 3}, resumed, ["8 runs", "12"]),
        ({}, [tmp_path / "none", "--resume"], ["nothing to resume", "leave out --resume"]),
        ({}, [tmp_path / "mine"], ["contains runs of something else", "--output"]),
        ({}, [tmp_path / "text"], ["cannot be written", "--output"]),
    ):
        file = sweep_file(tmp_path / "tiny.yaml", **fields)
        refused(main, [str(file), "--output", str(output), *more], capsys, *told, folder=tmp_path)
    lock = FolderLock(undisturbed)
    try:
        refused(main, [str(file), "--output", str(undisturbed), "--resume"], capsys, "Another run")
    finally:
        lock.release()
    assert {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")} == before


def test_a_damaged_result_is_refused(tmp_path, sweep_file, capsys):
    file, folder = sweep_file(tmp_path / "one.yaml", {"wind.seed": [1]}, 1, {"frames": 2}), tmp_path / "out"
    assert main([str(file), "--output", str(folder), *QUICK]) == 0
    (folder / "results/00000.json").write_text("{")
    table, again = (folder / "sweep.csv").read_bytes(), [str(file), "--output", str(folder), *QUICK, "--resume"]
    assert main(again) == 2
    assert "results/00000.json is damaged" in capsys.readouterr().err
    (folder / "results/00000.json").unlink()
    assert main(again) == 0
    assert (folder / "sweep.csv").read_bytes() == table  # all frames were there, so the run started again
