"""Particle-grid transfers against the conservation laws that define APIC."""

import pytest
import torch

from gaussian_swaying.mpm.state import GridSpec, bounding_grid
from gaussian_swaying.mpm.transfer import bspline_stencil, g2p, gather, p2g, scatter

DX = 0.1
GRID = GridSpec(DX, (0, 0, 0), (10, 10, 10))


def _particles(device, dtype, *batch, count=64):
    """Random position, mass, velocity and affine velocity, well inside the grid."""
    draw = torch.rand(*batch, count, 16, dtype=torch.float64).to(device, dtype)
    return (
        0.2 + 0.6 * draw[..., :3],
        0.5 + draw[..., 3],
        draw[..., 4:7] - 0.5,
        draw[..., 7:].unflatten(-1, (3, 3)) - 0.5,
    )


def _moment(position, momentum):
    return torch.linalg.cross(position.expand_as(momentum), momentum, dim=-1).sum(-2)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_p2g_conserves_mass_and_both_momenta(device, dtype, batch):
    """Angular momentum counts the affine part: eps : (C dx²/4)ᵀ m (Jiang et al. 2017)."""
    position, mass, velocity, affine = _particles(device, dtype, *batch)
    grid_mass, momentum = p2g(mass, velocity, affine, bspline_stencil(position, GRID))
    assert grid_mass.shape == (*batch, GRID.node_count)
    tol = 1e3 * torch.finfo(dtype).eps
    torch.testing.assert_close(grid_mass.sum(-1), mass.sum(-1), rtol=tol, atol=tol)
    torch.testing.assert_close(momentum.sum(-2), (mass[..., None] * velocity).sum(-2), rtol=tol, atol=tol)
    spin = mass[..., None, None] * affine * DX**2 / 4
    spin = torch.stack(
        [
            spin[..., 2, 1] - spin[..., 1, 2],
            spin[..., 0, 2] - spin[..., 2, 0],
            spin[..., 1, 0] - spin[..., 0, 1],
        ],
        dim=-1,
    ).sum(-2)
    expected = _moment(position, mass[..., None] * velocity) + spin
    torch.testing.assert_close(_moment(GRID.node_positions(position), momentum), expected, rtol=tol, atol=tol)


def test_round_trip_reproduces_affine_field(device, dtype):
    """APIC is exact on v(x) = v0 + A x; PIC, a transposed C or a wrong 4/dx² is not."""
    position, mass, velocity, affine = _particles(device, dtype)
    v0, a = velocity[0], affine[:1]
    expected = v0 + position @ a[0].T
    stencil = bspline_stencil(position, GRID)
    grid_mass, momentum = p2g(mass, expected, a.expand_as(affine), stencil)
    velocity, affine, gradient = g2p(momentum / grid_mass.clamp_min(1e-12)[:, None], stencil, DX)
    tol = 1e3 * torch.finfo(dtype).eps
    torch.testing.assert_close(velocity, expected, rtol=tol, atol=tol)
    torch.testing.assert_close(affine, a.expand_as(affine), rtol=tol, atol=10 * tol)
    torch.testing.assert_close(gradient, a.expand_as(affine), rtol=tol, atol=10 * tol)


def test_basis_identities():
    """Partition of unity, zero first moment, second moment dx²/4 (quadratic B-splines)."""
    position = _particles("cpu", torch.float64)[0]
    stencil = bspline_stencil(position, GRID)
    total = stencil.basis.sum(-1)
    expected = torch.zeros_like(total)
    expected[:, 0] = 1
    torch.testing.assert_close(total, expected, rtol=0, atol=1e-12)
    offset = GRID.node_positions(position)[stencil.node].reshape(-1, 27, 3) - position[:, None]
    second = torch.einsum("pi,pia,pib->pab", stencil.basis[:, 0], offset, offset)
    torch.testing.assert_close(second, (DX**2 / 4 * torch.eye(3, dtype=torch.float64)).expand_as(second))
    torch.testing.assert_close(stencil.basis[:, 4:], (stencil.basis[:, :1] * offset.mT))


def test_gather_is_the_adjoint_of_scatter(device):
    position = _particles(device, torch.float64)[0]
    stencil = bspline_stencil(position, GRID)
    coefficients = torch.rand(64, 7, 2, dtype=torch.float64, device=device)
    field = torch.rand(GRID.node_count, 2, dtype=torch.float64, device=device)
    left = (scatter(stencil, coefficients) * field).sum()
    torch.testing.assert_close(left, (gather(field, stencil) * coefficients).sum())


def test_gradient_rows_match_autograd():
    position = _particles("cpu", torch.float64, count=5)[0].requires_grad_()
    field = torch.rand(GRID.node_count, 1, dtype=torch.float64)
    rows = gather(field, bspline_stencil(position, GRID))
    (gradient,) = torch.autograd.grad(rows[:, 0].sum(), position)
    torch.testing.assert_close(rows[:, 1:4, 0], gradient)


def test_moved_grid_gives_the_same_weights():
    """Every grid is a window of one lattice, so a grid that follows the object changes nothing."""
    position = _particles("cpu", torch.float32)[0]
    a, b = bspline_stencil(position, GRID), bspline_stencil(position, GridSpec(DX, (-3, -1, -2), (20, 15, 17)))
    assert torch.equal(a.basis, b.basis)


def test_batch_scenes_do_not_touch():
    position, mass, velocity, affine = _particles("cpu", torch.float64, 3)
    together = p2g(mass, velocity, affine, bspline_stencil(position, GRID))
    for b in range(3):
        alone = p2g(mass[b], velocity[b], affine[b], bspline_stencil(position[b], GRID))
        torch.testing.assert_close(together[0][b], alone[0], rtol=0, atol=1e-14)
        torch.testing.assert_close(together[1][b], alone[1], rtol=0, atol=1e-14)


@pytest.mark.parametrize("outside", [[-0.2, 0.5, 0.5], [0.5, 0.5, 1.2], [0.5, 0.96, 0.5], [1e9, 0.5, 0.5]])
def test_particle_outside_is_reported_and_never_wrapped(device, outside):
    """In a flattened grid a particle beyond one face would silently act on the far side."""
    position = torch.tensor([outside, [0.5, 0.5, 0.5]], device=device)
    stencil = bspline_stencil(position, GRID)
    assert stencil.inside.tolist() == [False, True]
    mass, _ = p2g(torch.tensor([5.0, 1.0], device=device), position * 0, torch.zeros(2, 3, 3, device=device), stencil)
    torch.testing.assert_close(mass.sum(), torch.tensor(1.0, device=device))


def test_snap_leaves_no_vanishing_weight():
    """Half-cell planes: weights that would be 1e-16 become exactly zero and the rest still sums to one."""
    position = torch.tensor([[0.45, 0.5, 0.5 + 1e-9], [0.45 + 1e-9, 0.35 - 1e-9, 0.5]], dtype=torch.float64)
    weights = bspline_stencil(position, GRID, snap=1e-6).basis[:, 0]
    assert not bool(((weights > 0) & (weights < 1e-12)).any())
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, dtype=torch.float64))


def test_bounding_grid_holds_every_stencil():
    position = torch.rand(500, 3) * torch.tensor([3.0, 0.01, 1.0]) - 1.2
    grid = bounding_grid(position.amin(0), position.amax(0), 0.07, margin=0)
    assert bool(bspline_stencil(position, grid).inside.all())
    smaller = GridSpec(0.07, grid.offset, (grid.resolution[0] - 1, *grid.resolution[1:]))
    assert not bool(bspline_stencil(position, smaller).inside.all())


def test_p2g_gradcheck(device):
    inputs = [t.requires_grad_() for t in _particles(device, torch.float64, count=3)]
    assert torch.autograd.gradcheck(lambda x, m, v, c: p2g(m, v, c, bspline_stencil(x, GRID)), inputs, fast_mode=True)


@pytest.mark.parametrize(("name", "shape"), [("velocity", (64, 2)), ("velocity", (63, 3)), ("affine", (64, 9))])
def test_p2g_rejects_wrong_shape(name, shape):
    position, mass, velocity, affine = _particles("cpu", torch.float32)
    particles = {"mass": mass, "velocity": velocity, "affine": affine, name: torch.zeros(shape)}
    with pytest.raises(ValueError, match=rf"Expected `{name}` of shape .* but got"):
        p2g(**particles, stencil=bspline_stencil(position, GRID))
