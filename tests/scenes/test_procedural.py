import math

import pytest
import torch
from shared import near, peak, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.scenes.printed_cloth import PERIOD, printed_colours
from gaussian_swaying.scenes.procedural import FlagScene


def test_normals_are_perpendicular_to_the_rippled_sheet():
    """The sheet is y = a sin(k x): its normal is (-a k cos(k x), 1, 0), and each centre lies on it."""
    cloud = FlagScene(spacing=0.05, ripple=0.05).generate()
    k = 2 * math.pi * 1.5 / 1.2
    x, y, _ = cloud.means.double().unbind(-1)
    near(y, 0.05 * torch.sin(k * x), 1e-7)
    expected = torch.stack([-0.05 * k * torch.cos(k * x), torch.ones_like(x), torch.zeros_like(x)], -1)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    normals = GaussianSurfaceModel.from_cloud(cloud).normals().double()
    assert peak(expected[:, 0]) > 0.3  # the ripple is steep enough to tell
    near((normals * expected).sum(-1).abs(), torch.ones_like(x), 1e-6)


@pytest.mark.parametrize("spacing", [0.1, 0.05])
def test_areas_add_up_to_the_flag(spacing):
    cloud = FlagScene(width=1.2, height=0.8, spacing=spacing, ripple=0.0).generate()
    assert len(cloud) == round(1.2 / spacing) * round(0.8 / spacing)
    areas = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False).areas("coverage")
    assert float(areas.sum()) == pytest.approx(1.2 * 0.8, rel=0.02)


def test_size_and_place():
    cloud = FlagScene(width=0.6, height=0.4, spacing=0.1).generate()
    low, high = cloud.means.amin(0), cloud.means.amax(0)
    assert_close(low[[0, 2]], torch.tensor([0.05, 0.05]))
    assert_close(high[[0, 2]], torch.tensor([0.55, 0.35]))
    assert peak(cloud.means[:, 1]) <= 0.003


def test_yaw_turns_the_flag_about_its_pole():
    plain, turned = (FlagScene(spacing=0.1, ripple=0.03, yaw=yaw).generate() for yaw in (0.0, -35.0))
    c, s = math.cos(math.radians(35)), math.sin(math.radians(35))
    turn = torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    assert_close(turned.means, plain.means @ turn.T)
    before, after = (GaussianSurfaceModel.from_cloud(cloud, requires_grad=False).normals() for cloud in (plain, turned))
    near(after, before @ turn.T, 1e-6)


def test_patterns():
    stripes, white = (FlagScene(spacing=0.01, pattern=name).generate() for name in ("stripes", "white"))
    colours, counts = stripes.sh[:, 0].unique(dim=0, return_counts=True)
    pure = colours[counts.argsort(descending=True)[:4]]  # three bands and the disc
    apart = torch.cdist(stripes.sh[:, 0], pure).amin(1)
    assert 0.9 < (apart < 1e-6).float().mean() < 1  # the others lie on an edge, and have a colour in between
    a, b = torch.triu_indices(4, 4, 1)
    share = ((stripes.sh - pure[a]) * (pure[b] - pure[a])).sum(-1) / (pure[b] - pure[a]).square().sum(-1)
    between = torch.lerp(pure[a], pure[b], share.clamp(0, 1)[..., None])
    assert float((stripes.sh - between).norm(dim=-1).amin(1).quantile(0.999)) < 1e-5  # but for where three meet
    assert len(white.sh.unique(dim=0)) == 1
    assert white.sh.shape == (9600, 1, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0.0),
        ("height", -1.0),
        ("spacing", 0.0),
        ("spacing", float("nan")),
        ("overlap", 0.0),
        ("ripple", -0.1),
        ("pattern", "dots"),
        ("yaw", float("inf")),
        ("spacing", 0.9),
    ],
)
def test_bad_arguments(name, value):
    with value_error(f"generator.{name}"):
        FlagScene(**{name: value})


def test_a_printed_flag_has_the_colours_of_its_print():
    scene = FlagScene(width=0.6, height=0.4, spacing=0.02, pattern="printed", yaw=20.0)
    plain = FlagScene(width=0.6, height=0.4, spacing=0.02, pattern="printed").generate()
    wanted = printed_colours(plain.means[:, 0], plain.means[:, 2])
    near((0.5 + SH_DC * scene.generate().sh[:, 0]).double(), wanted, 1e-5)


def test_a_print_can_be_told_everywhere():
    """In every square of 20 cm the colours vary; no two such squares are alike; the same place has the same colour."""
    x, z = torch.meshgrid(torch.arange(0.0, 1.6, 0.01), torch.arange(0.0, 1.6, 0.01), indexing="ij")
    colours = printed_colours(x, z)
    assert colours.min() >= 0
    assert colours.max() <= 1
    near(printed_colours(x[:5] + PERIOD, z[:5]), colours[:5], 1e-5)
    squares = colours.reshape(8, 20, 8, 20, 3).permute(0, 2, 1, 3, 4).reshape(64, -1)
    squares = squares - squares.mean(1, keepdim=True)
    size = squares.norm(dim=1) / squares.shape[1] ** 0.5
    assert size.min() > 0.1
    alike = squares @ squares.T / squares.norm(dim=1).outer(squares.norm(dim=1)) - torch.eye(64)
    assert alike.max() < 0.7
