"""Whole sweeps with worker processes: disturbed ones end as undisturbed ones, and failures stop nothing."""

import csv
import errno
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from shared import refused

from gaussian_swaying.cli.sweep import explain, main
from gaussian_swaying.runs.lock import LOCK, FolderLock, FolderLocked
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps import worker
from gaussian_swaying.sweeps.backend import Job
from gaussian_swaying.sweeps.worker import do

from .conftest import holders, kill_in_a_run

PROGRAM = "import sys; from gaussian_swaying.cli.main import main; sys.exit(main())"


def _start(file, folder, *more):
    """The command as a process, in a session of its own."""
    command = [sys.executable, "-c", PROGRAM, "sweep", str(file), "--output", str(folder), "--workers", "2", *more]
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)


def _wait(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


def _done(folder):
    return {file: file.stat().st_mtime_ns for file in (folder / "results").glob("[0-9]*.json")}


def _rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _kill_workers(folder, times, seed, over):
    """Kill a worker at random, some times; returns how often.

    Runs are kept locked and let go one by one, so that they are not all done before, however fast the machine is.
    """
    stream, killed, longest, kept = random.Random(seed), 0, 0.2, []
    gone = {os.getpid()}  # and those that were killed, whose locks stay
    _wait(lambda: (folder / "sweep.csv").exists() or over())
    for number in range(8):
        run = folder / f"runs/{number:05d}"
        run.mkdir(parents=True, exist_ok=True)
        with suppress(FolderLocked):  # it has begun
            kept.append(FolderLock(run))
    while killed < times and not over():
        if kept:
            kept.pop(0).release()
        while not (found := set(holders(folder).values()) - gone) and not over():
            time.sleep(0.005)
        time.sleep(stream.uniform(0.0, longest))
        process = stream.choice(sorted(found)) if found else None
        if process is not None and kill_in_a_run(folder, process) is not None:
            gone.add(process)
            killed += 1
        else:
            longest /= 2  # a run of a fast machine is over within the pause
    for lock in kept:
        lock.release()
    return killed


def _disturbed(file, folder, kills, seed, *more):
    """A sweep in which workers are killed; how often, and its exit code."""
    codes, killed = [], []
    options = ["--output", str(folder), "--workers", "2", "--device", "cpu", *more]
    killer = threading.Thread(
        target=lambda: killed.append(_kill_workers(folder, kills, seed, lambda: bool(codes))), daemon=True
    )
    killer.start()
    codes.append(main([str(file), *options]))
    killer.join()
    return killed[0], codes[0]


def _same_motion(one, two, name):
    with np.load(one / "runs" / name / "trajectory.npz") as a, np.load(two / "runs" / name / "trajectory.npz") as b:
        assert a.files == b.files
        assert all(np.array_equal(a[entry], b[entry]) for entry in a.files)


# ---- what a sweep writes


def test_a_sweep(undisturbed):
    rows = _rows(undisturbed / "sweep.csv")
    assert [row["run"] for row in rows] == [f"{number:05d}" for number in range(8)]
    assert {row["status"] for row in rows} == {"complete"}
    assert [json.loads(row["wind.flow"])[0] for row in rows] == [4.0] * 4 + [8.0] * 4
    assert len({row["wind_work_J"] for row in rows}) == 8
    for row in rows:
        summary = json.loads((undisturbed / "runs" / row["run"] / "summary.json").read_text())
        assert summary["status"] == "complete"
        assert summary["sweep"]["settings"]["wind.seed"] == int(row["wind.seed"]) == summary["seed"]
        assert float(row["displacement_mean_max_m"]) == summary["displacement_mean_max_m"]
        assert float(row["kinetic_end_J"]) == summary["energy_end_J"]["kinetic"]
        assert int(row["frames"]) == 12
        assert (undisturbed / "runs" / row["run"] / "video.mp4").exists()
    assert not [name for name in rows[0] if "wall" in name or "time" in name]
    times = _rows(undisturbed / "times.csv")
    assert {row["attempts"] for row in times} == {"1"}
    assert all(float(row["simulation_s"]) > 0 for row in times)
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


def test_killed_workers_change_nothing(undisturbed, tmp_path, sweep_file):
    killed, code = _disturbed(sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out", 3, seed=1)
    assert (killed, code) == (3, 0)
    assert sum(int(row["attempts"]) for row in _rows(tmp_path / "out/times.csv")) > 8
    assert (tmp_path / "out/sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()
    for number in range(8):
        _same_motion(undisturbed, tmp_path / "out", f"{number:05d}")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_forty_runs_and_five_killed_workers(tmp_path, sweep_file):
    file = sweep_file(tmp_path / "tiny.yaml", draws=10)
    assert main([str(file), "--output", str(tmp_path / "whole"), "--workers", "2", "--device", "cpu"]) == 0
    killed, code = _disturbed(file, tmp_path / "out", 5, seed=2)
    assert (killed, code) == (5, 0)
    assert len(_rows(tmp_path / "out/sweep.csv")) == 40
    assert (tmp_path / "out/sweep.csv").read_bytes() == (tmp_path / "whole/sweep.csv").read_bytes()


@pytest.mark.slow
def test_a_killed_driver_loses_only_what_was_running(undisturbed, tmp_path, sweep_file, capsys):
    file, folder = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out"
    driver = _start(file, folder, "--device", "cpu")
    _wait(lambda: len(_done(folder)) >= 2 and holders(folder))
    driver.kill()
    driver.communicate()
    before = _done(folder)
    assert len(before) >= 2
    assert main([str(file), "--output", str(folder), "--workers", "2", "--device", "cpu", "--resume"]) == 0
    after = _done(folder)
    assert {path: after[path] for path in before} == before
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()


@pytest.mark.slow(gate=["15-143"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_sweep_ends_in_order(undisturbed, tmp_path, sweep_file, number, code):
    """Ctrl-C reaches the workers too, SIGTERM only the driver."""
    file, folder = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out"
    driver = _start(file, folder, "--device", "cpu")
    _wait(lambda: (folder / "sweep.csv").exists())
    (folder / "runs/00007").mkdir(parents=True)
    last = FolderLock(folder / "runs/00007")  # so that the sweep goes on until it is stopped
    _wait(lambda: len(_done(folder)) == 7 or (_done(folder) and len(holders(folder)) > 1))
    (os.killpg if number == signal.SIGINT else os.kill)(driver.pid, number)
    _, error = driver.communicate(timeout=120)
    last.release()
    assert driver.returncode == code, error
    assert "Stopped; complete runs are kept" in error
    assert "--resume" in error
    assert "Traceback" not in error
    assert list(folder.rglob(LOCK)) == []
    rows = _rows(folder / "sweep.csv")
    complete = {path.stem for path in _done(folder)}
    assert {row["run"] for row in rows if row["status"] == "complete"} == complete
    assert {row["status"] for row in rows} == {"complete", "missing"}
    assert main([str(file), "--output", str(folder), "--workers", "2", "--device", "cpu", "--resume"]) == 0
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()


def test_ctrl_c_while_the_workers_start(tmp_path, sweep_file):
    """They import for seconds; Ctrl-C of the terminal reaches them too, and nobody prints a traceback."""
    folder = tmp_path / "out"
    driver = _start(sweep_file(tmp_path / "tiny.yaml"), folder, "--device", "cpu")
    _wait(lambda: (folder / "sweep.csv").exists())

    def importing():
        """Processes of the sweep that have begun to load torch, the driver left out."""
        children = " ".join(file.read_text() for file in Path(f"/proc/{driver.pid}/task").glob("*/children"))
        return sum("libtorch" in Path(f"/proc/{child}/maps").read_text() for child in children.split())

    _wait(lambda: importing() == 2)
    os.killpg(driver.pid, signal.SIGINT)
    _, error = driver.communicate(timeout=120)
    assert driver.returncode == 130, error
    assert "Traceback" not in error
    assert "--resume" in error
    assert {row["status"] for row in _rows(folder / "sweep.csv")} == {"missing"}


# ---- failures


def test_failed_runs_are_recorded_and_stop_nothing(tmp_path, sweep_file, capsys):
    axes = {"wind.flow": [[4.0, 1.0, 0.0], [2e6, 0.0, 0.0]], "material.nu": [0.3, 0.5]}
    file, folder = sweep_file(tmp_path / "bad.yaml", axes, 1, {"frames": 4}), tmp_path / "out"
    assert main([str(file), "--output", str(folder), "--workers", "2", "--device", "cpu"]) == 2
    told = capsys.readouterr()
    assert "4 runs: 1 complete, 1 diverged, 2 failed" in told.out
    assert "error: 3 of 4 runs failed" in told.err
    assert "Traceback" not in told.err
    rows = _rows(folder / "sweep.csv")
    assert [row["status"] for row in rows] == ["complete", "failed", "diverged", "failed"]
    assert "`material.nu`" in rows[1]["reason"]
    assert "wind" in rows[2]["reason"]
    assert [row["attempts"] for row in _rows(folder / "times.csv")] == ["1", "2", "2", "2"]
    assert (folder / "contact_sheet.png").exists()
    before = _done(folder)
    assert main([str(file), "--output", str(folder), "--workers", "2", "--device", "cpu", "--resume"]) == 2
    after = _done(folder)
    assert [path.stem for path in sorted(before) if after[path] == before[path]] == ["00000"]  # others are tried again
    assert _rows(folder / "sweep.csv") == rows


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "frames/00003.png"), ("frames/00003.png", "make room")),
        (MemoryError(), ("not enough memory", "--workers")),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 64 bytes"), ("memory",)),
        (ZeroDivisionError("division by zero"), ("division by zero",)),
        (AssertionError("odd"), ("AssertionError: odd", "logs")),
    ],
)
def test_what_failed_is_told_in_one_sentence(tmp_path, monkeypatch, error, words):
    def fail(job, parser):
        raise error

    monkeypatch.setattr(worker, "_run", fail)
    (tmp_path / "logs").mkdir()
    done = do(Job(tmp_path, ("00000",), "", 2, ({},), attempt=2), None, explain)
    result = done.results["00000"]
    assert (result["status"], result["attempts"], done.ready) == ("failed", 2, False)
    for word in words:
        assert word in result["reason"]
    assert "\n" not in result["reason"]
    assert "Traceback" in (tmp_path / "logs/00000.txt").read_text()


def test_a_run_whose_process_is_killed_too_often_is_recorded(undisturbed, tmp_path, sweep_file, capsys):
    file, folder = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out"
    assert _disturbed(file, folder, 1, 3, "--retries", "0") == (1, 2)
    error = capsys.readouterr().err
    (bad,) = [row for row in _rows(folder / "sweep.csv") if row["status"] != "complete"]
    assert bad["status"] == "failed"
    assert "SIGKILL" in bad["reason"]
    assert "--workers" in bad["reason"]
    assert f"run {bad['run']} failed" in error
    assert main([str(file), "--output", str(folder), "--workers", "1", "--device", "cpu", "--resume"]) == 0
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()


# ---- refused


def _refuse(arguments, capsys, *words):
    refused(main, [str(argument) for argument in arguments], capsys, *words)


def test_other_settings_are_refused(undisturbed, tmp_path, sweep_file, capsys):
    before = {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")}
    same = sweep_file(tmp_path / "same.yaml")
    _refuse([same, "--output", undisturbed], capsys, "holds a sweep already", "--resume", "--output")
    other = sweep_file(tmp_path / "other.yaml", settings={"material.density": 40.0})
    _refuse([other, "--output", undisturbed, "--resume"], capsys, "other settings", "material.density", "30.0", "40.0")
    seed = sweep_file(tmp_path / "seed.yaml", seed=1)
    _refuse([seed, "--output", undisturbed, "--resume"], capsys, "other settings", "wind.seed")
    more = sweep_file(tmp_path / "more.yaml", draws=3)
    _refuse([more, "--output", undisturbed, "--resume"], capsys, "8 runs", "12")
    assert {path: path.stat().st_mtime_ns for path in undisturbed.rglob("*")} == before


def test_folders_of_others_are_refused(tmp_path, sweep_file, capsys):
    file = sweep_file(tmp_path / "tiny.yaml")
    _refuse([file, "--output", tmp_path / "none", "--resume"], capsys, "nothing to resume", "leave out --resume")
    assert not (tmp_path / "none").exists()
    (tmp_path / "mine/runs").mkdir(parents=True)
    _refuse([file, "--output", tmp_path / "mine"], capsys, "contains runs of something else", "--output")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["runs"]
    (tmp_path / "text").write_text("")
    _refuse([file, "--output", tmp_path / "text"], capsys, "cannot be written", "--output")


def test_one_sweep_at_a_time(undisturbed, tmp_path, sweep_file, capsys):
    lock = FolderLock(undisturbed)
    try:
        _refuse([sweep_file(tmp_path / "tiny.yaml"), "--output", undisturbed, "--resume"], capsys, "Another run")
    finally:
        lock.release()


def test_a_damaged_result_is_refused(tmp_path, sweep_file, capsys):
    file, folder = sweep_file(tmp_path / "one.yaml", {"wind.seed": [1]}, 1, {"frames": 2}), tmp_path / "out"
    assert main([str(file), "--output", str(folder), "--workers", "1", "--device", "cpu"]) == 0
    (folder / "results/00000.json").write_text("{")
    _, table = capsys.readouterr(), (folder / "sweep.csv").read_bytes()
    assert main([str(file), "--output", str(folder), "--resume"]) == 2
    assert "00000.json is damaged" in (error := capsys.readouterr().err)
    assert "remove it" in error
    (folder / "results/00000.json").unlink()
    assert main([str(file), "--output", str(folder), "--workers", "1", "--device", "cpu", "--resume"]) == 0
    assert (folder / "sweep.csv").read_bytes() == table  # all frames were there, so the run started again
