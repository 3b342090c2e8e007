"""Sweeps of tiny flags: as a file, and done once without disturbance."""

import json
import multiprocessing
import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.runs.lock import LOCK
from gaussian_swaying.sweeps import pool

FLAG = Path(__file__).parents[2] / "configs/sim/flag.yaml"
_POLE = {"class_path": "Box", "init_args": {"min": [None, None, None], "max": [0.11, None, None]}}

SETTINGS = {
    "frames": 12,
    "scene.generator.init_args.spacing": 0.1,
    "solver.dx": 0.2,
    "solver.boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": _POLE}}],
    "camera.init_args.width": 32,
    "camera.init_args.height": 18,
}
"""Options of all runs."""
AXES = {
    "wind.flow": [[4.0, 1.0, 0.0], [8.0, 2.0, 0.0]],
    "material.E": {"from": 3e3, "to": 3e4, "count": 2, "scale": "log"},
    "wind.seed": {"draw": "integer", "low": 0, "high": 10**6},
}
"""Four runs for each draw."""


def write_sweep(path, axes=AXES, draws=2, settings=None, **more):
    """A sweep file of tiny flags; ``settings`` are added to those that make them tiny."""
    fields = {"base": str(FLAG), "settings": SETTINGS | (settings or {}), "axes": axes, "draws": draws}
    path.write_text(yaml.safe_dump(fields | more, sort_keys=False))
    return path


def holders(folder):
    """The process that writes to each run, by the name of the run."""
    found = {}
    for lock in sorted((folder / "runs").glob(f"*/{LOCK}")):
        with suppress(OSError, ValueError):  # it has just ended
            found[lock.parent.name] = json.loads(lock.read_bytes())["pid"]
    return found


def kill_in_a_run(folder, process):
    """Kill a process while it writes to a run; the name of the run, or None if it writes to none now.

    It is stopped first, as otherwise it might end the run between the look and the kill; and it is waited for, as its
    lock stays, and a zombie could be killed once more.
    """
    name, end = None, time.monotonic() + 60
    with suppress(ProcessLookupError):
        os.kill(process, signal.SIGSTOP)
        name = next((name for name, holder in holders(folder).items() if holder == process), None)
        os.kill(process, signal.SIGCONT if name is None else signal.SIGKILL)
        while name is not None and time.monotonic() < end:
            os.kill(process, 0)
            time.sleep(0.005)
    return name


@pytest.fixture(scope="session")
def sweep_file():
    """Writes a sweep file to a path; eight runs unless told otherwise."""
    return write_sweep


@pytest.fixture(scope="session")
def _workers():
    """Workers that have imported everything: forks of one process. Sweeps in a process of their own spawn theirs."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        yield
        return
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(
        ["gaussian_swaying.cli.sweep", "gaussian_swaying.simulation.simulation", "torch._dynamo"]
    )
    with pytest.MonkeyPatch.context() as changes:
        changes.setattr(pool, "get_context", lambda method: server)
        yield


@pytest.fixture(autouse=True)
def _quick_workers(_workers):
    """For every test of this folder."""


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, _workers):
    """Folder of the sweep of eight runs."""
    folder = tmp_path_factory.mktemp("sweep")
    file = write_sweep(folder / "tiny.yaml")
    assert main([str(file), "--output", str(folder / "whole"), "--workers", "2", "--device", "cpu"]) == 0
    return folder / "whole"
