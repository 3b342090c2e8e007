"""A small flag, and a session of it."""

import time

import pytest

from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.session import Session

SMALL = [
    "--config=configs/sim/flag.yaml",
    "--solver.dx=0.1",
    "--scene.generator.init_args.spacing=0.025",
    "--material.E=9e3",  # soft, for few substeps
    "--device=cpu",
]


@pytest.fixture(scope="session")
def parser():
    return Simulation.parser()


@pytest.fixture
def settings(parser, request):
    root = request.config.rootpath
    return parser.parse_args([SMALL[0].replace("configs", str(root / "configs")), *SMALL[1:]])


@pytest.fixture
def session(parser, settings):
    """A session that is not started yet; it is closed at the end."""
    made = Session(parser, settings)
    yield made
    made.close()


def until(condition, seconds=20.0):
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


@pytest.fixture(name="until")
def _until():
    return until
