"""Sweeps of tiny flags: as a file, and done once without disturbance."""

import multiprocessing
from pathlib import Path

import pytest
import yaml
from bench.problems.small_sweep import AXES, SETTINGS

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.sweeps import pool

FLAG = Path(__file__).parents[2] / "configs/sim/flag.yaml"


def write_sweep(path, axes=AXES, draws=2, settings=None, **more):
    """A sweep file of tiny flags; ``settings`` are added to those that make them tiny."""
    fields = {"base": str(FLAG), "settings": SETTINGS | (settings or {}), "axes": axes, "draws": draws}
    path.write_text(yaml.safe_dump(fields | more, sort_keys=False))
    return path


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
