"""A small printed flag in the wind."""

import pytest
from handheld_films import write_base

from gaussian_swaying.inverse.fit import Problem, fit
from gaussian_swaying.inverse.plan import Plan, read_unknown
from gaussian_swaying.inverse.videos import read_videos
from gaussian_swaying.simulation.simulation import Simulation


@pytest.fixture
def simulation(own):
    """The flag."""
    return Simulation.from_yaml(own / "base.yaml", device="cpu")


@pytest.fixture
def brief(monkeypatch):
    """Gaussians are matched once."""
    monkeypatch.setattr("gaussian_swaying.inverse.fit.STEPS", (1.0,))


@pytest.fixture
def plan_of(own):
    """The plan of a fit of unknowns with these ranges to a video of the flag."""

    def plan_of(unknowns, folder=None, **settings):
        sought = [read_unknown(*one) for one in unknowns.items()]
        return Plan([str(own / "base.yaml")], [str(folder or own / "video")], sought, **settings)

    return plan_of


@pytest.fixture
def fit_of(plan_of, simulation):
    """Such a fit, of some videos instead of those of the plan if they are given."""

    def fit_of(unknowns, folder=None, videos=None, further=None, **settings):
        plan = plan_of(unknowns, folder, **settings)
        return Problem(simulation, videos or read_videos(plan.videos), plan, **(further or {}))

    return fit_of


@pytest.fixture
def fitted(own, tmp_path):
    """The result of a whole fit, whose folder is ``fit``."""

    def fitted(unknowns, folder=None, **settings):
        options = {"device": "cpu", "progress": False} | settings
        return fit(own / "base.yaml", folder or own / "video", unknowns, tmp_path / "fit", **options)

    return fitted


@pytest.fixture(scope="session")
def walls(tmp_path_factory):
    """The configuration of a flag in front of two walls."""
    return write_base(tmp_path_factory.mktemp("walls"), wall=0.04)


@pytest.fixture
def room(walls):
    """Its simulation."""
    return Simulation.from_yaml(walls, device="cpu")
