"""Small scenes that are built from tensors, as fixtures of conftest.py."""

import dataclasses
import math
from functools import partial

import pytest
import torch
from shared import unit

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.scenes import FlagScene, GivenScene
from gaussian_swaying.simulation.body import Material, Scene, SimulatedScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.cost import Cost
from gaussian_swaying.suggestion.suggest import suggest
from gaussian_swaying.wind.field import WindField


def _make_cloud(count=40, degree=1, opacity=0.9, seed=0, offset=0.0):
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(*shape, generator=generator)

    return GaussianCloud(
        means=random(count, 3) + offset,
        quats=random(count, 4) - 0.5,
        scales=(0.02 + 0.1 * random(count, 3)).log(),
        opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=0.5 * (random(count, (degree + 1) ** 2, 3) - 0.5),
    )


def plain_cloud(means, log_scales=-4.0, quats=(1.0, 0.0, 0.0, 0.0), logit=3.0):
    """Grey Gaussians at places (N, 3); sizes, rotations and opacities are one for all or each its own."""
    count = len(means)
    return GaussianCloud(
        means=means.float(),
        quats=torch.as_tensor(quats).expand(count, 4),
        scales=torch.as_tensor(log_scales).expand(count, 3),
        opacities=torch.as_tensor(logit).expand(count),
        sh=torch.zeros(count, 1, 3),
    )


def coloured(cloud, color, where=slice(None)):
    sh = cloud.sh.clone()
    sh[where, 0] = (torch.tensor(color) - 0.5) / SH_DC
    return dataclasses.replace(cloud, sh=sh)


GREEN = (0.2, 0.5, 0.15)


def block(sides, color, count=3000):
    draw = torch.Generator().manual_seed(0)
    low, high = torch.zeros(3), torch.tensor(sides)
    place = low + (high - low) * torch.rand(count, 3, generator=draw)
    face = torch.randint(6, (count,), generator=draw)
    for k in range(6):
        place[face == k, k // 2] = (low if k % 2 else high)[k // 2]
    return coloured(plain_cloud(place + torch.tensor([3.0, 4.0, 0.0])), color)


def blobs(centres, radius, color, count, seed=0):
    """Thin discs that face anywhere, in balls around centres (N, 3)."""
    draw = torch.Generator().manual_seed(seed)
    own = torch.tensor(centres)[torch.randint(len(centres), (count,), generator=draw)]
    place = own + radius * torch.randn(count, 3, generator=draw).clamp(-1.5, 1.5) / 1.5
    turn = unit(count, 4, generator=draw, dtype=torch.float32)
    return coloured(plain_cloud(place, (-4.2, -4.2, -6.0), turn), color)


def shrub(count=4000):
    """Nine leafy stems of 1 m that lean outwards from one foot."""
    stems = [(0.0, 0.0)] + [(math.cos(a), math.sin(a)) for a in torch.arange(8.0).mul(math.pi / 4).tolist()]
    at = [
        (0.12 * x + 0.3 * h * h * x, 0.12 * y + 0.3 * h * h * y, h)
        for x, y in stems
        for h in torch.linspace(0, 1, 24).tolist()
    ]
    return blobs(at, 0.05, GREEN, count)


def young_tree(count=4000):
    """A trunk of 1.2 m below a round crown."""
    trunk = blobs([(0.0, 0.0, h) for h in torch.linspace(0, 1.2, 60).tolist()], 0.03, (0.4, 0.3, 0.2), count // 4)
    crown = [(0.25 * math.cos(a), 0.25 * math.sin(a), h) for a in torch.arange(6.0).tolist() for h in (1.2, 1.5, 1.8)]
    return together(trunk, blobs(crown, 0.18, GREEN, 3 * count // 4, 1))


def lamp(count=3000):
    """A shade on a cord of 0.6 m."""
    cord = blobs([(0.0, 0.0, h) for h in torch.linspace(0.3, 0.95, 60).tolist()], 0.012, (0.1, 0.1, 0.1), count // 3)
    return together(cord, blobs([(0.0, 0.0, 0.15)], 0.17, (0.7, 0.2, 0.2), 2 * count // 3, 1))


def run_cost(dx, **numbers):
    found = {"device": "", "particles": 1, "grid": (1, 1, 1), "frames": 51, "substeps": 1, "picture_seconds": None}
    return Cost(dx=dx, **(found | dict.fromkeys(("substep_seconds", "simulation_seconds"), 1.0) | numbers))


def started(found, cloud, folder, frames=2):
    """The simulation of the configuration of a suggestion."""
    write_ply(folder / "it.ply", cloud)
    found.to_yaml(folder / "starter.yaml", frames, folder / "it.ply")
    return Simulation.from_yaml(folder / "starter.yaml", device="cpu")


def previewed(cloud, folder, **options):
    """The suggestion for a splat with z up, and the simulation of its configuration."""
    found = suggest(cloud, **{"up": "+z", "device": "cpu", "quality": "draft", **options})
    return found, started(found, cloud, folder, 250)


guess = partial(suggest, tune=False)
"""All but the numbers with which a thing sways, which takes seconds."""


def varied_cloud(count=300, degree=1, seed=0, normals=False):
    draw = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(*shape, generator=draw)

    return GaussianCloud(
        means=4 * random(count, 3) - 1,
        quats=random(count, 4) - 0.5,
        scales=-4 + 2 * random(count, 3),
        opacities=6 * random(count) - 2,
        sh=0.8 * (random(count, (degree + 1) ** 2, 3) - 0.5),
        normals=torch.nn.functional.normalize(random(count, 3) - 0.5, dim=-1) if normals else None,
    )


def turned_cloud(cloud, quat):
    w, x, y, z = quat
    a, b, c, d = cloud.quats.unbind(-1)
    quats = torch.stack(
        [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
         w * d + x * c - y * b + z * a], -1)  # fmt: skip
    return GaussianCloud(cloud.means @ quat_to_rotation(quat).T, quats, cloud.scales, cloud.opacities, cloud.sh)


def together(*clouds):
    names = ("means", "quats", "scales", "opacities", "sh")
    return GaussianCloud(*(torch.cat([getattr(cloud, name) for cloud in clouds]) for name in names))


@pytest.fixture
def make_cloud():
    return _make_cloud


@pytest.fixture
def make_scene():
    """A SimulatedScene of a splat (a random one by default), one point for each Gaussian unless told otherwise."""

    def make(cloud=None, material=None, dx=0.25, dtype=torch.float32, **settings):
        cloud = _make_cloud() if cloud is None else cloud
        settings = {"points": "gaussian", **settings}
        return SimulatedScene(Scene(generator=GivenScene(cloud), **settings), material or Material(), dx, dtype)

    return make


@pytest.fixture
def make_simulation():
    """A flag of 96 Gaussians on its pole, one point for each unless told otherwise, 32 x 18 pixels."""

    def make(
        cloud=None,
        wind=None,
        shader=None,
        camera=None,
        aero=None,
        scene=None,
        material=None,
        pinned=True,
        frame_dt=0.04,
        dtype=torch.float32,
        background=(0.0, 0.0, 0.0),
        parts=None,
        **solver,
    ):
        source = FlagScene(spacing=0.1) if cloud is None else GivenScene(cloud)
        solver = {"dx": 0.2, **solver}
        if pinned:
            solver["boundaries"] = [PinnedRegion(Box([None, None, None], [0.11, None, None]))]
        return Simulation(
            Scene(generator=source, **{"points": "gaussian", **(scene or {})}),
            material or Material(E=3e3, density=30.0),
            solver=MPMSolver(**solver),
            wind=wind or WindField([6.0, 1.5, 0.0]),
            aero=aero,
            shader=shader,
            camera=camera or OrbitCamera(width=32, height=18, azimuth=-70.0, radius=1.9),
            background=background,
            frame_dt=frame_dt,
            dtype=str(dtype).removeprefix("torch."),
            device="cpu",
            **(parts or {}),
        )

    return make


@pytest.fixture
def flag_ply(tmp_path):
    """The small flag as a file, y up instead of z, in units of 0.3 m, far from the origin."""
    cloud = FlagScene(spacing=0.05).generate()
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z to y
    half = math.sqrt(0.5)
    w, x, y, z = cloud.quats.unbind(-1)
    quats = half * torch.stack([w + x, x - w, y + z, z - y], -1)  # by -90 degrees about x
    means = cloud.means @ turn.T / 0.3 + torch.tensor([5.0, -3.0, 2.0])
    path = tmp_path / "flag.ply"
    write_ply(path, GaussianCloud(means, quats, cloud.scales - math.log(0.3), cloud.opacities, cloud.sh))
    return path
