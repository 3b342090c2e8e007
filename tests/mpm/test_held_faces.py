"""Clamps hold the face of a region: where it is, which bodies are sheets, and what a clamped solid does."""

import math
import warnings

import pytest
import torch
from shared import Chosen, solid
from torch.testing import assert_close

from gaussian_swaying import Box, MPMSolver, PinnedPoints, PinnedRegion
from gaussian_swaying.geometry.regions import Everything
from gaussian_swaying.mpm.pins import MOST_ROWS, SOFTENED, Handle, along_face, face, thickness

DX = 0.1


def _box(x, y, z, step=0.25, turn=0.0):
    """Points in a box of so many cells, one corner at the origin, turned about y."""
    axes = [(torch.arange(max(round(side / step), 1), dtype=torch.float64) + 0.5) * step * DX for side in (x, y, z)]
    rest = torch.cartesian_prod(*axes)
    c, s = math.cos(turn), math.sin(turn)
    return rest @ torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64).T


def _material(rest):
    return solid(rest, 1e-5)


# ---- the face


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_face_lies_between_held_and_free_points(turn):
    rest = _box(6, 1, 2)
    held = rest[:, 0] < 0.2
    place, across = face(_box(6, 1, 2, turn=turn), held, DX)
    c, s = math.cos(turn), math.sin(turn)
    normal = torch.tensor([c, 0.0, s], dtype=torch.float64)
    assert len(place) == 4 * 8  # each held point of the last layer has its partner
    assert_close(place @ normal, torch.full((32,), 0.2, dtype=torch.float64), rtol=0, atol=1e-12)
    assert_close(across, normal.expand_as(across), rtol=0, atol=1e-12)


def test_what_is_far_apart_has_no_face():
    rest = torch.cat([_box(1, 1, 1), _box(1, 1, 1) + 0.35])
    held = torch.arange(len(rest)) < len(rest) // 2
    assert len(face(rest, held, DX)[0]) == 0
    assert len(face(rest, torch.ones_like(held), DX)[0]) == 0
    assert len(face(rest, held, 4 * DX)[0]) > 0


def test_slopes_lie_along_the_face_or_are_all_three():
    normal = torch.tensor([[0.0, 0.6, 0.8], [0.1, 0.0, 0.0]], dtype=torch.float64)
    some, every = along_face(normal)
    assert_close(some[:2] @ some[:2].T, torch.eye(2, dtype=torch.float64))
    assert_close(some @ normal[0], torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-15)
    assert bool((some[2] == 0).all())
    assert torch.equal(every, torch.eye(3, dtype=torch.float64))


def test_a_large_face_takes_larger_patches():
    """60 x 60 cells have 14,400 patches of half a cell; their rows would not fit."""
    rest = _box(2, 60, 60, step=0.5)
    solver = MPMSolver(DX, boundaries=[PinnedRegion(Chosen(rest[:, 0] < DX), "clamp")], gravity=(0, 0, 0))
    solver.init_state(_material(rest))
    assert 100 < solver.bound.pinned.W.shape[-1] <= MOST_ROWS


# ---- sheet or solid


@pytest.mark.parametrize(
    ("sides", "thick", "sheet"),
    [
        ((20, 12, 0.5), 0.5, True),
        ((20, 12, 1), 1.0, True),
        ((20, 12, 2), 2.0, False),
        ((20, 1, 0.5), 0.5, False),  # a cord
        ((20, 1, 2), 1.0, False),  # a beam in plane strain
        ((20, 12, 8), None, False),
    ],
)
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_sheet_is_thin_and_wide(sides, thick, sheet, turn):
    rest, points = _box(*sides), _box(*sides, turn=turn)
    found, thin = thickness(points, torch.ones(len(points)), points[rest[:, 0] < DX], DX)
    assert thin == sheet
    if thick is not None:  # layers of points have the moment of a body that is thinner by 1 - 1 / m²
        layers = round(thick / 0.25)
        assert found == pytest.approx(thick * DX * math.sqrt(1 - 1 / layers**2), rel=0.02)


def test_the_default_holds_a_sheet_by_a_hinge_and_a_solid_by_a_clamp():
    kinds = {}
    for name, sides in (("sheet", (12, 12, 0.5)), ("solid", (12, 2, 2)), ("cord", (12, 0.5, 0.5))):
        rest = _box(*sides)
        solver = MPMSolver(DX, boundaries=[PinnedRegion(Box([None] * 3, [0.07, None, None])), Handle(Everything())])
        solver.init_state(_material(rest))
        kinds[name] = solver.bound.kinds[0]
    assert kinds == {"sheet": "hinge", "solid": "face", "cord": "face"}


def test_what_cannot_hold_is_warned_of_at_the_start():
    solid = _material(_box(12, 2, 2))
    with pytest.warns(UserWarning, match=r"`kind: hinge` of the PinnedRegion .* 2 cells thick.* set `kind` to clamp"):
        MPMSolver(DX, boundaries=[PinnedRegion(Box([None] * 3, [0.07, None, None]), "hinge")]).init_state(solid)
    with pytest.warns(UserWarning, match=r"`kind: clamp` of the PinnedPoints .* still turns: use a PinnedRegion"):
        MPMSolver(DX, boundaries=[PinnedPoints([[0.05, 0.1, 0.1]], "clamp")]).init_state(solid)


@pytest.mark.parametrize("shift", [0.0, 0.03])
@pytest.mark.parametrize(("rows", "wide"), [(2, False), (4, False), (6, True), (12, True)])
def test_a_hinge_that_holds_several_lines_is_warned_of(rows, wide, shift):
    """Rows of points lie a quarter of a cell apart; lines closer than 0.6 cells are joined."""
    rest = _box(20, 12, 0.5) + torch.tensor([shift, 0.0, 0.0])
    region = Box([None] * 3, [shift + 0.25 * rows * DX, None, None])
    solver = MPMSolver(DX, boundaries=[PinnedRegion(region, "hinge")])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        solver.init_state(_material(rest))
    holds = solver.bound.pinned.rows
    along = holds.place[0, 0][~holds.slope[0, 0]][:, 0].sort()[0]
    assert (float(along[-1] - along[0]) > 0.3 * DX) == wide
    said = [str(one.message) for one in told if "holds several lines and with them the slope" in str(one.message)]
    assert bool(said) == wide


# ---- a clamped solid


def test_held_material_is_soft_and_takes_its_weight():
    """The stiffness of what is clamped for good is not needed; the pin carries the weight of the whole."""
    rest = _box(8, 1, 2)
    points = _material(rest)
    solver = MPMSolver(DX, boundaries=[PinnedRegion(Box([None] * 3, [0.4, None, None]))])
    state = solver.init_state(points)
    held = rest[:, 0] < 0.4
    mu = solver.laws.mu
    assert_close(mu[held], SOFTENED * mu[~held][:1].expand(int(held.sum())))
    assert torch.equal(solver.points.youngs_modulus, points.youngs_modulus)
    after = solver.rollout(state, 1e-3, 60)
    weight = torch.tensor([0.0, 0.0, -9.8], dtype=torch.float64) * points.mass.sum()
    gained = solver.momenta(after)["linear"]
    assert_close(gained, 0.06 * weight - after.impulse[0], rtol=0, atol=1e-12)
    assert float(after.impulse[0, 2]) < 0.5 * 0.06 * float(weight[2])  # at least what lies in the region
    assert float((after.position - rest)[rest[:, 0] < 0.05].norm(dim=-1).max()) < 1e-12


def test_a_clamp_that_opens_keeps_its_stiffness():
    rest = _box(8, 1, 2)
    pin = PinnedRegion(Box([None] * 3, [0.4, None, None]), "clamp", end=0.05)
    solver = MPMSolver(DX, boundaries=[pin])
    state = solver.init_state(_material(rest))
    assert len(solver.laws.mu.unique()) == 1
    held = solver.rollout(state, 1e-3, 50)
    assert float((held.position - rest)[rest[:, 0] < 0.05].norm(dim=-1).max()) < 1e-12
    fallen = solver.rollout(held, 1e-3, 100)
    assert bool((fallen.velocity[:, 2] < -0.5).all())
