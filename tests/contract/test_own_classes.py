"""Classes of a user's own, named by their class paths in a YAML: a force, an effect of the wind, a law, boundaries."""

import sys
from pathlib import Path

import pytest
import torch
import yaml
from shared import longest, near, peak

from gaussian_swaying import load_trajectory
from gaussian_swaying.cli.simulate import main

ROOT = Path(__file__).parents[2]
STRIP = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.11, None, None]}}
PIN = {"class_path": "PinnedRegion", "init_args": {"region": STRIP}}

OWN = '''
"""A pole that shakes what it holds, a ceiling on all speeds, a spring to a place, and a wind that a canopy slows."""

import math

import torch

from gaussian_swaying import Boundary, Force, PinnedRegion
from gaussian_swaying.wind.effects import WindEffect
from gaussian_swaying.geometry.regions import Region


class Shaker(PinnedRegion):
    """Moves the particles of a region up and down."""

    recordable = True

    def __init__(self, region: Region, amplitude: float, period: float) -> None:
        super().__init__(region)
        self.amplitude, self.rate = amplitude, 2 * math.pi / period

    def forward(self, velocity, nodes):
        before, after = (torch.sin(self.rate * time) for time in (nodes.time, nodes.time + nodes.dt))
        up = (self.amplitude * (after - before) / nodes.dt).to(velocity)
        driven = torch.stack([torch.zeros_like(up), torch.zeros_like(up), up])
        return torch.where(nodes.pinned[..., None], driven, velocity)


class SpeedLimit(Boundary):
    """Nothing is faster than this."""

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit

    def forward(self, velocity, nodes):
        speed = velocity.norm(dim=-1, keepdim=True)
        return velocity * (self.limit / speed.clamp(min=self.limit))


class Pull(Force):
    """Towards a place given in scene units."""

    recordable = True

    def __init__(self, target: list[float], strength: float = 1.0) -> None:
        super().__init__()
        self.register_buffer("target", torch.tensor(target))
        self.strength = strength

    def in_frame(self, frame):
        return Pull(frame.point_to_sim(self.target.double()).tolist(), self.strength)

    def forward(self, state):
        return self.strength * (self.target.to(state.position) - state.position)


class Canopy(WindEffect):
    """The wind is weaker by a factor below a height [m]."""

    recordable = True

    def __init__(self, height: float, factor: float = 0.0) -> None:
        super().__init__()
        self.height, self.factor = height, factor

    def forward(self, velocity, position, moment):
        return torch.where(position[..., 2:] < self.height, self.factor * velocity, velocity)
'''


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs a flag of twelve by eight Gaussians with changes: its settings as saved, and the positions."""
    (tmp_path / "my_classes.py").write_text(OWN)
    for folder in (tmp_path, ROOT / "examples"):
        monkeypatch.syspath_prepend(str(folder))

    def run(name, frames=4, boundaries=(PIN,), **changes):
        folder = tmp_path / name
        folder.mkdir()
        changes |= {
            "scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.1, "overlap": 0.6}}},
            "contact": None,
            "solver": {"dx": 0.2, "boundaries": list(boundaries)},
            "camera": {"class_path": "OrbitCamera", "init_args": {"width": 32, "height": 18}},
        }
        (folder / "changes.yaml").write_text(yaml.safe_dump(changes))
        configs = ["--config", str(ROOT / "configs/sim/flag.yaml"), "--config", str(folder / "changes.yaml")]
        assert main([*configs, "--frames", str(frames), "--device", "cpu", "--output", str(folder / "out")]) == 0
        stored = yaml.safe_load((folder / "out" / "config.yaml").read_text())
        positions = [load_trajectory(folder / "out" / "trajectory.npz", frame)[0] for frame in range(frames)]
        return stored, torch.stack(list(positions))

    yield run
    for name in ("my_classes", "custom_law"):
        sys.modules.pop(name, None)


def own(name, **init_args):
    return {"class_path": f"my_classes.{name}", "init_args": init_args}


def test_a_boundary(run):
    stored, moved = run("shaken", boundaries=[own("Shaker", region=STRIP, amplitude=0.05, period=0.16)])
    assert stored["solver"]["boundaries"][0]["class_path"] == "my_classes.Shaker"
    held = moved[0, :, 0] < moved[0, :, 0].min() + 0.05  # the first column
    assert int(held.sum()) == 8
    up = (moved - moved[0])[:, held, 2]
    # frames are a quarter of a period apart
    expected = torch.tensor([0.0, 0.05, 0.0, -0.05])[:, None].expand_as(up)
    near(up, expected, 1e-5)
    assert (moved[1] - moved[0])[~held].norm(dim=-1).min() > 0


def test_a_boundary_stands_beside_those_of_the_package(run):
    free = run("free")[1]
    stored, slow = run("slow", boundaries=[PIN, own("SpeedLimit", limit=0.1)])
    names = [boundary["class_path"] for boundary in stored["solver"]["boundaries"]]
    assert names[1] == "my_classes.SpeedLimit"
    assert names[0].rsplit(".", 1)[1] == "PinnedRegion"
    ways = [float(longest(moved[1:] - moved[:-1])) for moved in (free, slow)]
    assert ways[1] <= 0.1 * 0.04 * 1.001 < ways[0]


def test_a_force(run):
    """Towards a place three metres from the flag, along y."""
    free = run("free", wind={"flow": [0, 0, 0]})[1]
    stored, pulled = run("pulled", wind={"flow": [0, 0, 0]}, forces=[own("Pull", target=[1.0, 3.0, 0.5], strength=0.2)])
    assert stored["forces"] == [own("Pull", target=[1.0, 3.0, 0.5], strength=0.2)]
    assert (free[-1] - free[0])[:, 1].mean().abs() < 1e-3 < (pulled[-1] - pulled[0])[:, 1].mean()


def test_an_effect_of_the_wind(run):
    """In the first frame, what is well below the canopy hardly moves, and what is above it moves as without one."""
    free = run("free", wind={"flow": [0, 8, 0]})[1]
    stored, moved = run("below", wind={"flow": [0, 8, 0], "effects": [own("Canopy", height=0.0)]})
    assert stored["wind"]["effects"] == [own("Canopy", height=0.0, factor=0.0)]
    ways = [(end[1] - end[0])[:, 1] for end in (free, moved)]
    z = moved[0, :, 2]
    assert ways[1][z < -0.2].mean() < 0.2 * ways[0][z < -0.2].mean()
    assert ways[1][z > 0.2].mean() > 0.8 * ways[0][z > 0.2].mean()


def test_a_law(run):
    law = {"class_path": "custom_law.SaintVenant", "init_args": {"factor": 2.0}}
    stored, stiff = run("one", 2, material={"law": law})
    assert stored["material"]["law"] == law
    soft = run("soft", 2, material={"law": {"class_path": "custom_law.SaintVenant"}})[1]
    corotated = run("corotated", 2, material={"law": {"class_path": "FixedCorotated"}})[1]
    assert peak(stiff[1] - stiff[0]) > 1e-3
    assert peak(stiff[1] - soft[1]) > 1e-6
    # of the same stiffness at rest
    assert peak(soft[1] - corotated[1]) < 0.1 * peak(soft[1] - soft[0])
