"""Gaussians that follow points: motions with known answers, gradients, forces, and what the kernel must equal."""

import math

import pytest
import torch
from shared import value_error
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying import GaussianSurfaceModel, SplatSkin
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.geometry.rotations import quat_to_rotation

TURN = quat_to_rotation(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64))
SHIFT = torch.tensor([0.4, -0.2, 1.0], dtype=torch.float64)


def discs(places, normals=None):
    """Flat Gaussians at places, of which the smallest axis is z."""
    count = len(places)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=places.dtype).repeat(count, 1)
    scales = torch.tensor([-3.0, -3.5, -7.0], dtype=places.dtype).repeat(count, 1)
    return GaussianCloud(places, quats, scales, places[:, 0] * 0, places.new_zeros(count, 1, 3))


def lattice(count, width=1.0, dtype=torch.float64):
    line = torch.linspace(0, width, count, dtype=dtype)
    return torch.cartesian_prod(line, line, line.new_zeros(1))


def somewhere(count, depth=0.0):
    return torch.rand(count, 3, dtype=torch.float64) * torch.tensor([1.0, 1.0, depth], dtype=torch.float64)


def straight(points):
    line = torch.linspace(0, 1, 30, dtype=torch.float64)[:, None]
    return line * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)


BODIES = {
    "solid": lambda: (somewhere(400, 1.0), somewhere(100, 1.0)),
    "sheet": lambda: (lattice(12), somewhere(100) + torch.tensor([0, 0, 0.01])),
    "curved sheet": lambda: (bent(lattice(12), 1.0), bent(somewhere(100), 1.0)),
    "line": lambda: (straight(30), straight(30)[3:20] + 0.01 * torch.tensor([0.6, 0.0, 0.8])),
    "far from its points": lambda: (somewhere(400, 1.0), somewhere(50, 1.0) + 3),
    "three points": lambda: (torch.eye(3, dtype=torch.float64), somewhere(9, 1.0)),
}


def bent(flat, radius):
    """A flat sheet in the plane of x and y, rolled around an axis along y."""
    angle, out = flat[:, 0] / radius, radius - flat[:, 2]
    return torch.stack([out * angle.sin(), flat[:, 1], radius - out * angle.cos()], -1)


@pytest.mark.parametrize("body", BODIES)
def test_a_rigid_motion_is_exact(body):
    points, places = BODIES[body]()
    skin = SplatSkin(discs(places), points)
    moved = skin(points @ TURN.T + SHIFT)
    model = skin.gaussians
    assert_close(moved.means, places @ TURN.T + SHIFT, rtol=0, atol=1e-9)
    if body == "line":  # nothing tells how far it turns around itself
        along = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
        _, F = skin.motion(points @ TURN.T + SHIFT)
        assert_close(F @ along, (TURN @ along).expand(len(places), 3), rtol=0, atol=1e-9)
        assert_close(F @ F.mT, torch.eye(3, dtype=F.dtype).expand_as(F), rtol=0, atol=1e-9)
    else:
        assert_close(moved.covariances, TURN @ model.covariance() @ TURN.T, rtol=0, atol=1e-9)
        assert_close(moved.normals, model.normals() @ TURN.T, rtol=0, atol=1e-9)


def test_a_solid_takes_any_affine_map_exactly_and_a_sheet_one_in_its_plane():
    A = torch.eye(3, dtype=torch.float64) + 0.3 * torch.randn(3, 3, dtype=torch.float64)
    points, places = BODIES["solid"]()
    means, F = SplatSkin(discs(places), points).motion(points @ A.T)
    assert_close(means, places @ A.T, rtol=0, atol=1e-10)
    assert_close(F, A.expand_as(F), rtol=0, atol=1e-9)
    points, places = lattice(12), somewhere(100)
    means, F = SplatSkin(discs(places), points).motion(points @ A.T)
    assert_close(means, places @ A.T, rtol=0, atol=1e-10)
    normal = torch.linalg.cross(A[:, 0], A[:, 1])
    assert_close(F, torch.stack([A[:, 0], A[:, 1], normal / normal.norm()], -1).expand_as(F), rtol=0, atol=1e-10)
    whole = SplatSkin(discs(places), points).motion(points @ A.T, A.expand(len(points), 3, 3))[1]
    assert_close(whole, A.expand_as(whole), rtol=0, atol=1e-10)


def test_a_sheet_that_is_rolled_up_converges():
    """The displacement is of third order in the distance of the points, F of second order."""
    places = 0.6 * somewhere(200) + torch.tensor([0.2, 0.2, 0.0], dtype=torch.float64)
    errors = []
    for count in (17, 33):
        points = lattice(count)
        means, F = SplatSkin(discs(places), points).motion(bent(points, 0.5))
        angle = places[:, 0] / 0.5
        exact = torch.zeros_like(F)
        exact[:, 0, 0], exact[:, 2, 0], exact[:, 1, 1] = angle.cos(), angle.sin(), 1.0
        exact[:, 0, 2], exact[:, 2, 2] = -angle.sin(), angle.cos()
        errors.append(((means - bent(places, 0.5)).norm(dim=-1).mean(), (F - exact).flatten(1).norm(dim=-1).mean()))
    (place, slope), (fine_place, fine_slope) = errors
    assert place / fine_place > 7
    assert slope / fine_slope > 3.5
    assert fine_place < 1e-5
    assert fine_slope < 2e-3


def test_a_line_that_is_bent_keeps_its_frame():
    """The tangent follows the curve, the normals stay across it."""
    points = torch.linspace(0, 1, 60, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0, 0], dtype=torch.float64)
    places = points[5:-5] + torch.tensor([0.002, 0.0, 0.01], dtype=torch.float64)
    means, F = SplatSkin(discs(places), points).motion(bent(points, 0.4))
    assert_close(means, bent(places, 0.4), rtol=0, atol=2e-4)
    assert_close(F @ F.mT, torch.eye(3, dtype=torch.float64).expand_as(F), rtol=0, atol=1e-3)


def test_faces_keep_two_sheets_apart():
    below = lattice(12)
    points = torch.cat([below, below + torch.tensor([0.0, 0.0, 0.01])])
    number = torch.arange(144).reshape(12, 12)
    one = torch.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    faces = torch.cat([one[:, [0, 1, 2]], one[:, [0, 2, 3]]])
    places = somewhere(200) * 0.9
    apart = points.clone()
    apart[144:, 1] += 2.0  # the other sheet flies away
    mixed = SplatSkin(discs(places), points)(apart).means
    kept = SplatSkin(discs(places), points, faces=torch.cat([faces, faces + 144]))(apart)
    assert (mixed - places).norm(dim=-1).max() > 0.1
    assert_close(kept.means, places, rtol=0, atol=1e-12)
    assert_close(kept.normals, torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(200, 3), rtol=0, atol=1e-12)


def test_forces_on_points_have_the_sum_and_the_power_of_those_on_gaussians():
    points, places = BODIES["solid"]()
    skin = SplatSkin(discs(places), points)
    force, velocity = torch.randn(2, 100, 3, dtype=torch.float64), torch.randn(2, 400, 3, dtype=torch.float64)
    spread = skin.spread(force)
    assert_close(spread.sum(-2), force.sum(-2))
    assert_close((spread * velocity).sum((-2, -1)), (force * skin.velocity(velocity)).sum((-2, -1)))
    turning = torch.linalg.cross(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand_as(points), points)
    wanted = torch.linalg.cross(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand_as(places), places)
    assert_close(skin.velocity(turning), wanted)


def test_batches_and_gradients():
    points, places = BODIES["curved sheet"]()
    skin = SplatSkin(discs(places[:4]), points)
    motions = torch.stack([bent(points, 2.0), points @ TURN.T])
    both = skin(motions)
    for k, motion in enumerate(motions):
        one = skin(motion)
        for name in ("means", "covariances", "normals"):
            assert_close(getattr(both, name)[k], getattr(one, name))
    near = skin.index.unique().long()

    def of_some(moved):
        found = skin(motions[0].index_copy(0, near, moved))
        return found.means, found.covariances, found.normals

    assert torch.autograd.gradcheck(of_some, motions[0][near].clone().requires_grad_(), atol=1e-7)


@pytest.mark.parametrize("given", [False, True], ids=["positions", "positions and F"])
@pytest.mark.parametrize("body", BODIES)
def test_the_kernel_equals_the_definition(device, body, given):
    points, places = (part.to(device, torch.float32) for part in BODIES[body]())
    cloud = varied_cloud(len(places), 1).to(device)
    cloud.means.copy_(places)
    skin = SplatSkin(cloud, points)
    moved = points @ TURN.T.to(points) + 0.1 * (3 * points).sin()
    F = torch.eye(3, device=device) + 0.2 * torch.randn(len(points), 3, 3, device=device) if given else None
    found = skin(moved, F)
    wanted = skin(moved.clone().requires_grad_(), F)
    assert (wanted.means.requires_grad, found.means.requires_grad) == (True, False)
    for name in ("means", "covariances", "normals", "rotations"):
        assert_close(getattr(found, name), getattr(wanted, name).detach(), rtol=1e-4, atol=2e-5)


def test_a_model_in_training_keeps_its_gradient():
    points = lattice(8, dtype=torch.float32)
    model = GaussianSurfaceModel(discs(somewhere(20).float()))
    moved = SplatSkin(model, points)(points + 1)
    (moved.means.sum() + moved.covariances.sum()).backward()
    assert_close(model.means.grad, torch.ones(20, 3))
    assert (model.scales.grad[:, 0] > 0).all()


def test_bad_points_are_refused():
    cloud, points = discs(somewhere(5)), somewhere(9, 1.0)
    with value_error("finite place"):
        SplatSkin(cloud, points * math.nan)
    with value_error("from 0 to 8, but got 9"):
        SplatSkin(cloud, points, faces=torch.tensor([[0, 1, 9]]))
    skin = SplatSkin(cloud, points)
    with pytest.raises(ValueError, match="points"):
        skin(points[:8])
    with pytest.raises(ValueError, match="deformation_gradient"):
        skin(points, torch.eye(3).repeat(8, 1, 1))
    with pytest.raises(TypeError, match="`points` in float64, as the Gaussians are, but got float32"):
        skin(points.float())
