import multiprocessing
from functools import partial
from pathlib import Path

import pytest
import torch
import yaml
from loky import ProcessPoolExecutor
from shared import SMALL

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.sweeps import run

FLAG = Path(__file__).parents[2] / "configs/sim/flag.yaml"
AXES = {
    "wind.flow": [[4.0, 1.0, 0.0], [8.0, 2.0, 0.0]],
    "material.E": {"from": 3e3, "to": 3e4, "count": 2, "scale": "log"},
    "wind.seed": {"draw": "integer", "low": 0, "high": 10**6},
}
"""Four runs for each draw."""


def write_sweep(path, axes=AXES, draws=2, settings=None, **more):
    fields = {"base": str(FLAG), "settings": SMALL | {"frames": 12} | (settings or {}), "axes": axes, "draws": draws}
    path.write_text(yaml.safe_dump(fields | more, sort_keys=False))
    return path


@pytest.fixture(scope="session")
def sweep_file():
    """Writes a sweep file to a path; eight runs unless told otherwise."""
    return write_sweep


@pytest.fixture(scope="session")
def _workers():
    if torch.cuda.is_available() or "forkserver" not in multiprocessing.get_all_start_methods():
        yield
        return
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(
        ["gaussian_swaying.cli.sweep", "gaussian_swaying.simulation.simulation", "torch._dynamo"]
    )
    with pytest.MonkeyPatch.context() as changes:
        changes.setattr(run, "ProcessPoolExecutor", partial(ProcessPoolExecutor, context=server))
        yield


@pytest.fixture(autouse=True)
def _quick_workers(_workers):
    """For every test of this folder."""


@pytest.fixture
def kill(monkeypatch):
    """Lets so many jobs be the last of their workers, which are killed when they have got them."""

    def begin(jobs):
        submit, left = run.Processes.submit, list(range(jobs))

        def submitting(self, job):
            future = submit(self, job)
            if left:
                left.pop()
                (process,) = self._executors[self._places[future]]._processes.values()
                process.kill()
            return future

        monkeypatch.setattr(run.Processes, "submit", submitting)

    return begin


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, _workers):
    folder = tmp_path_factory.mktemp("sweep")
    file = write_sweep(folder / "tiny.yaml")
    assert main([str(file), "--output", str(folder / "whole"), "--workers", "2", "--device", "cpu"]) == 0
    return folder / "whole"
