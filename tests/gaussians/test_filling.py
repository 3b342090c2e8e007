"""Filling of solids against closed forms: volumes, holes, cavities, open surfaces, and what must not matter."""

import math
from functools import cache

import pytest
import torch
from shared import EYE, double, normalized, rand, seeded, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians.filling import (
    InteriorFilling,
    density_grid,
    depth_below,
    enclosed,
    grid_around,
    open_air,
)

H = 0.05  # m, cells

# How far the surface may lie off, on average over a closed body [cells]. The depth behind a plane is right to 0.05
# (test_depth_below_a_plane). A blur of the standard deviation w = 1.0, the depth of a sheet of these Gaussians, moves a
# curved one by w² (1 / R1 + 1 / R2) / 2: 0.1 for a ball of ten cells and 0.13 for a tube of three and that depth.
OFF = 0.18


def _discs(normals, sigma):
    n = normals[:, :, None]
    flat = EYE - n * n.mT
    return sigma**2 * (flat + 0.01 * n * n.mT)


def _ball(radius, spacing=H):
    """Points of a Fibonacci lattice on a sphere, and their normals."""
    count = round(4 * math.pi * radius**2 / spacing**2)
    k = torch.arange(count).double() + 0.5
    z, angle = 1 - 2 * k / count, math.pi * (1 + math.sqrt(5)) * k
    across = (1 - z * z).sqrt()
    normals = torch.stack([across * angle.cos(), across * angle.sin(), z], -1)
    return radius * normals, normals


def _torus(ring, tube, spacing=H):
    u = torch.arange(round(2 * math.pi * (ring + tube) / spacing)).double()
    v = torch.arange(round(2 * math.pi * tube / spacing)).double()
    u, v = torch.cartesian_prod(2 * math.pi * u / len(u), 2 * math.pi * v / len(v)).unbind(-1)
    normals = torch.stack([v.cos() * u.cos(), v.cos() * u.sin(), v.sin()], -1)
    middle = ring * torch.stack([u.cos(), u.sin(), torch.zeros_like(u)], -1)
    return middle + tube * normals, normals


def _box(sides, spacing=H):
    points, normals = [], []
    for axis in range(3):
        a, b = (i for i in range(3) if i != axis)
        lines = [(torch.arange(round(sides[i] / spacing)).double() + 0.5) * spacing - 0.5 * sides[i] for i in (a, b)]
        face = torch.cartesian_prod(*lines)
        for side in (-1, 1):
            x, n = torch.zeros(2, len(face), 3).double()
            x[:, a], x[:, b], x[:, axis] = face[:, 0], face[:, 1], 0.5 * side * sides[axis]
            n[:, axis] = side
            points.append(x)
            normals.append(n)
    return torch.cat(points), torch.cat(normals)


def _shell(*surfaces):
    return tuple(torch.cat(parts) for parts in zip(*surfaces, strict=True))


@cache
def _bodies():
    ball, hollow = _ball(0.5), _shell(_ball(0.5), _ball(0.25))
    torus = _torus(0.4, 0.15)
    tilt = double([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3
    box = _box((1.0, 0.8, 0.6))
    return {
        "ball": (*ball, math.pi / 6, math.pi),
        "hollow": (*hollow, math.pi / 6 * 7 / 8, math.pi * 5 / 4),
        "torus": (*torus, 2 * math.pi**2 * 0.4 * 0.15**2, 4 * math.pi**2 * 0.4 * 0.15),
        "tilted torus": (*(part @ tilt for part in torus), 2 * math.pi**2 * 0.4 * 0.15**2, 4 * math.pi**2 * 0.06),
        "box": (*box, 0.48, 3.76),
        "tilted box": (*(part @ tilt for part in box), 0.48, 3.76),
    }


def _body(name):
    return _bodies()[name][:2]


def _fill(points, normals, spacing=H, sigma=0.6 * H, **settings):
    settings = {"spacing": spacing, **settings}
    chunk = settings.pop("chunk", 1_000_000)
    opacity = torch.full((len(points),), 0.99)
    return InteriorFilling(**settings).fill(points, _discs(normals, sigma), opacity, progress=False, chunk=chunk)


# ---- the pieces


def test_density_of_one_gaussian_is_its_formula():
    mean = double([[0.31, 0.52, 0.47]])
    scales = double([0.08, 0.05, 0.002])
    q, _ = torch.linalg.qr(rand(3, 3))
    cov = (q * scales**2) @ q.T
    low, n = torch.zeros(3).double(), (20, 21, 22)
    density = density_grid(mean, cov[None], torch.tensor([0.8]), low, H, n)
    axes = [(torch.arange(k).double() + 0.5) * H for k in n]
    offset = torch.cartesian_prod(*axes).reshape(*n, 3) - mean[0]
    wide = cov + 0.25 * H**2 * EYE
    distance = (offset @ torch.linalg.inv(wide) * offset).sum(-1)
    peak = 0.8 * (scales[:2].square() / (scales[:2].square() + 0.25 * H**2)).prod().sqrt()
    expected = (peak * (-0.5 * distance).exp()).float()
    near = density > 0  # kernels end at three standard deviations along the axes
    assert_close(density[near], expected[near], rtol=1e-4, atol=1e-6)
    assert expected[~near].max() <= 0.8 * math.exp(-4.5)


def test_a_gaussian_that_blew_up_is_cut_off():
    cov = EYE[None] * 1e6
    mean = torch.full((1, 3), 0.5, dtype=torch.float64)
    density = density_grid(mean, cov, torch.ones(1), torch.zeros(3), H, (20, 20, 20), max_radius=2)
    assert (density > 0).sum() == 5**3


def test_votes_decide():
    """A cube with one open face: below it 9 of 26 rays leave, so 17/26 of them say inside."""
    dense = torch.zeros(11, 11, 11, dtype=torch.bool)
    dense[2:9, 2:9, 2:9] = True
    dense[3:8, 3:8, 3:] = False
    assert enclosed(dense, votes=0.65)[5, 5, 7]
    assert not enclosed(dense, votes=0.66)[5, 5, 7]
    dense[2:9, 2:9, 8] = True
    assert int(enclosed(dense, votes=1.0).sum()) == 5**3
    assert not (enclosed(dense) & dense).any()


def test_open_air_goes_round_corners_but_not_through_walls():
    air = torch.ones(9, 9, 9, dtype=torch.bool)
    air[2:7, 2:7, 2:7] = False
    air[3:6, 3:6, 3:6] = True  # a cavity
    assert not open_air(air)[4, 4, 4]
    air[2, 3, 3] = True  # a hole near a corner
    assert torch.equal(open_air(air), air)


@pytest.mark.parametrize("normal", [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [1.0, 1.0, 1.0]])
@pytest.mark.parametrize("width", [0.75, 1.0, 2.0])
def test_depth_below_a_plane(normal, width):
    n = torch.tensor(normal)
    n = n / n.norm()
    size = 25
    x = torch.cartesian_prod(*(torch.arange(float(size)) - 12,) * 3)
    true = (x @ n + 0.3).reshape(size, size, size)
    found = depth_below(true > 0, width)
    middle = (slice(6, 19),) * 3  # outside the grid counts as air
    error = (found - true)[middle][true[middle].abs() < 1.5 * width]
    assert error.mean().abs() < 0.35  # the cells of an aligned plane cannot tell where within them it lies
    if normal[0]:
        assert error.mean().abs() < 0.05
        assert error.std() < 0.25


# ---- bodies


def _total_volume(filling):
    """Volume of the solid [m³]."""
    return float(filling.volume.sum() + filling.gaussian_volume.sum())


@pytest.mark.parametrize("name", _bodies())
@pytest.mark.parametrize("per_cell", [1, 8])
def test_volume_against_the_closed_form(name, per_cell):
    points, normals, volume, area = _bodies()[name]
    filling = _fill(points, normals, particles_per_cell=per_cell)
    assert abs(_total_volume(filling) - volume) < OFF * H * area
    assert filling.volume.min() > 0
    assert filling.volume.max() <= H**3 / per_cell * (1 + 1e-12)
    # all Gaussians lie on the surface, so all have a share
    assert (filling.gaussian_volume > 0).double().mean() > 0.95


def test_a_point_is_added_only_where_there_is_no_gaussian():
    points, normals = _body("ball")
    filling = _fill(points, normals, jitter=0.0)
    low, _ = grid_around(points, H)
    gaussian, added = (
        {tuple(cell) for cell in ((x - low) / H).floor().long().tolist()} for x in (points, filling.position)
    )
    assert len(added) == len(filling.position)
    assert not gaussian & added


def test_scale_does_not_matter():
    points, normals = _body("ball")
    small = _fill(points, normals)
    large = _fill(1024 * points, normals, spacing=1024 * H, sigma=0.6 * 1024 * H)
    assert_close(large.position, 1024 * small.position)
    assert_close(large.volume, 1024**3 * small.volume)


def test_points_lie_inside_and_holes_stay_empty():
    """Distance to the ball, the ring of the torus and the walls of the hollow ball; half a cell beyond is allowed."""
    x = _fill(*_body("torus")).position
    assert torch.hypot(x[:, :2].norm(dim=-1) - 0.4, x[:, 2]).max() < 0.15 + H
    radius = _fill(*_body("hollow")).position.norm(dim=-1)
    assert radius.max() < 0.5 + H
    assert radius.min() > 0.25 - H


def test_which_gaussians_are_on_the_surface():
    ball = _ball(0.5)
    points, normals = _body("hollow")
    assert torch.equal(_fill(points, normals).on_surface, torch.arange(len(points)) < len(ball[0]))
    line = torch.arange(-0.5, 0.5, H, dtype=torch.float64) + 0.3 * H
    core = torch.cartesian_prod(line, line, line)
    core = core[core.norm(dim=-1) < 0.5 - 0.5 * H]
    both = _shell(ball, (core, normalized(core)))
    filling = _fill(*both)
    deep = 0.5 - both[0].norm(dim=-1)
    assert filling.on_surface[deep < 0.5 * H].all()
    assert not filling.on_surface[deep > 2 * H].any()
    # the median Gaussian now lies inside, where cells are denser: the sheet counts as 0.13 cells deeper, 1.06 for 0.94
    assert abs(_total_volume(filling) + 0.13 * H * math.pi - math.pi / 6) < OFF * H * math.pi
    # only elements of the outer half cell, 3 H / 2 R of the ball, can be without a Gaussian
    assert filling.gaussian_volume.sum() > (1 - 3 * H / (2 * 0.5)) * _total_volume(filling)


def test_a_torn_surface_is_outvoted():
    """Three quarters of a dense ball taken away at random leave no hole wider than the Gaussians."""
    points, normals = _ball(0.5, 0.5 * H)
    keep = torch.randperm(len(points), generator=seeded(1))[: len(points) // 4]
    filling = _fill(points[keep], normals[keep])
    assert abs(_total_volume(filling) - math.pi / 6) < OFF * H * math.pi


def test_open_surfaces_enclose_nothing():
    u = torch.cartesian_prod(torch.arange(24).double(), torch.arange(16).double()) * H
    flag = torch.stack([u[:, 0], 0.05 * torch.sin(5 * u[:, 0]), u[:, 1]], -1)
    across = normalized(
        torch.stack([-0.25 * torch.cos(5 * u[:, 0]), torch.ones(len(u)), torch.zeros(len(u))], -1)
    ).double()
    ball = _ball(0.5)
    bowl = ball[0][:, 2] < -0.1
    for points, normals in ((flag, across), (ball[0][bowl], ball[1][bowl])):
        with value_error(r"Expected `filling` to find an inside.*remove `filling`"):
            _fill(points, normals, votes=0.9)
    with value_error("find an inside"):
        _fill(flag, across)


# ---- what must not matter, and what must


def test_chunks_do_not_matter():
    points, normals = _body("torus")
    one, two = (_fill(points, normals, particles_per_cell=8, chunk=chunk) for chunk in (1_000_000, 3_001))
    for name in ("position", "volume", "gaussian_volume", "on_surface"):
        assert torch.equal(getattr(one, name), getattr(two, name)), name


def test_the_seed_moves_points_within_their_elements():
    points, normals = _body("ball")
    first, again, other, regular = (
        _fill(points, normals, **options).position
        for options in ({"seed": 3}, {"seed": 3}, {"seed": 4}, {"jitter": 0.0})
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert (first - regular).abs().max() <= 0.25 * H  # jitter of half the distance
    low, _ = grid_around(points, H)
    phase = ((regular - low) / H) % 1
    assert_close(phase, torch.full_like(phase, 0.5))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"spacing": -1.0}, "filling.spacing"),
        ({"threshold": 0.0}, "filling.threshold"),
        ({"directions": 14}, "6, 18 or 26, but got 14"),
        ({"votes": 0.5}, "filling.votes"),
        ({"particles_per_cell": 4}, "filling.particles_per_cell"),
        ({"jitter": 1.5}, "filling.jitter"),
        ({"max_radius": 0}, "filling.max_radius"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    with value_error(words):
        InteriorFilling(**settings)


def test_bad_bodies_are_refused():
    points, normals = _body("ball")
    with value_error(r"at most 30,000,000 cells.*raise it"):
        _fill(points, normals, spacing=5e-4)
    points = points.clone()
    points[3, 1] = float("nan")
    with value_error("finite"):
        _fill(points, normals)
