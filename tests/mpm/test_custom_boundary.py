"""A custom boundary, from outside the package: one file, named by its class path in a YAML."""

import sys
from pathlib import Path

import pytest
import torch
import yaml

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.mpm.boundaries import BOUNDARIES
from gaussian_swaying.recording.trajectory import load_trajectory

ROOT = Path(__file__).parents[2]
STRIP = {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [0.11, None, None]}}

BOUNDARIES_OF_A_USER = '''
"""A pole that shakes what it holds, and a ceiling on all speeds."""

import math

import torch

from gaussian_swaying import Boundary, PinnedRegion
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
        return torch.where(nodes.held[..., None], driven, velocity)


class SpeedLimit(Boundary):
    """Nothing is faster than this."""

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit

    def forward(self, velocity, nodes):
        speed = velocity.norm(dim=-1, keepdim=True)
        return velocity * (self.limit / speed.clamp(min=self.limit))
'''


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs a flag of twelve by eight Gaussians: the class paths of its boundaries as saved, and the positions."""
    (tmp_path / "user_boundaries.py").write_text(BOUNDARIES_OF_A_USER)
    monkeypatch.syspath_prepend(str(tmp_path))

    def run(name, boundaries, frames=4):
        folder = tmp_path / name
        folder.mkdir()
        changes = {
            "scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.1}}},
            "solver": {"dx": 0.2, "boundaries": boundaries},
            "camera": {"class_path": "OrbitCamera", "init_args": {"width": 32, "height": 18}},
        }
        (folder / "changes.yaml").write_text(yaml.safe_dump(changes))
        configs = ["--config", str(ROOT / "configs/sim/flag.yaml"), "--config", str(folder / "changes.yaml")]
        assert main([*configs, "--frames", str(frames), "--device", "cpu", "--output", str(folder / "out")]) == 0
        stored = yaml.safe_load((folder / "out" / "config.yaml").read_text())["solver"]["boundaries"]
        positions = [load_trajectory(folder / "out" / "trajectory.npz", frame)[0] for frame in range(frames)]
        return [entry["class_path"] for entry in stored], torch.stack(list(positions))

    yield run
    sys.modules.pop("user_boundaries", None)


def test_a_custom_boundary_runs_from_a_yaml(run):
    assert not {"Shaker", "SpeedLimit"} & set(BOUNDARIES)
    shaker = {
        "class_path": "user_boundaries.Shaker",
        "init_args": {"region": STRIP, "amplitude": 0.05, "period": 0.16},
    }
    names, moved = run("shaken", [shaker])
    assert names == ["user_boundaries.Shaker"]
    held = moved[0, :, 0] < moved[0, :, 0].min() + 0.05  # the first column
    assert int(held.sum()) == 8
    up = (moved - moved[0])[:, held, 2]
    # frames are a quarter of a period apart
    expected = torch.tensor([0.0, 0.05, 0.0, -0.05])[:, None].expand_as(up)
    torch.testing.assert_close(up, expected, rtol=0, atol=1e-5)
    assert float((moved[1] - moved[0])[~held].norm(dim=-1).min()) > 0


def test_a_custom_boundary_stands_beside_those_of_the_package(run):
    pin = {"class_path": "PinnedRegion", "init_args": {"region": STRIP}}
    limit = {"class_path": "user_boundaries.SpeedLimit", "init_args": {"limit": 0.1}}
    free = run("free", [pin])[1]
    names, slow = run("slow", [pin, limit])
    assert names[1] == "user_boundaries.SpeedLimit"
    assert names[0].rsplit(".", 1)[1] == "PinnedRegion"
    ways = [float((moved[1:] - moved[:-1]).norm(dim=-1).max()) for moved in (free, slow)]
    assert ways[1] <= 0.1 * 0.04 * 1.001 < ways[0]
