"""Hard cases of contact end finite, or are refused with a sentence."""

from dataclasses import replace

import pytest
import torch
from contacts import crossings, sheet_triangles

from gaussian_swaying import Contact, MaterialPoints

from .bodies import layers, march, scene, sheet

THICKNESS = 0.01


def _finite(state):
    return bool(torch.isfinite(state.position).all() & torch.isfinite(state.velocity).all())


def test_sheets_in_the_same_place_come_apart():
    """Three sheets exactly in one place: the impulses are finite, momentum stays, and no speed is above the bound."""
    solver, state = layers(3, 0.0)
    for later in march(solver, state, 0.02, frame=0.005):
        assert _finite(later)
        assert float(later.velocity.norm(dim=-1).max()) < 5.0
    torch.testing.assert_close(solver.momenta(later)["linear"], torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)


def test_everything_in_contact_at_half_the_thickness():
    """Every place of five sheets overlaps its neighbours: the pile opens in order, at bounded speeds."""
    solver, state = layers(5, 0.5 * THICKNESS, stiffness_damping=1e-3)
    later = march(solver, state, 0.1, frame=0.02)[-1]
    height = later.position[:, 2].reshape(5, -1)
    assert _finite(later)
    assert float((height[1:] - height[:-1]).min()) > 0.9 * THICKNESS
    assert float(later.velocity.norm(dim=-1).max()) < 2.0


def test_a_thickness_above_the_spacing_is_kept():
    """Three times the distance of the points: two sheets stop that far from each other, and leave themselves alone."""
    below, above = sheet(14, 14), sheet(8, 8, (0.053, 0.047, 0.2))
    points = MaterialPoints.join([below, above])
    velocity = torch.zeros_like(points.position)
    velocity[below.count :, 2] = -2.0
    solver, state = scene(points, Contact(thickness=0.06, friction=0.0), velocity=velocity, gravity=(0, 0, 0))
    still = march(solver, state, 0.04, frame=0.02)[-1]
    torch.testing.assert_close(still.position[: below.count], below.position, rtol=0, atol=1e-12)
    triangles = torch.cat([sheet_triangles(14, 14), sheet_triangles(8, 8, below.count)])
    least = 1.0
    for later in march(solver, still, 0.12, frame=0.02):
        assert _finite(later)
        assert crossings(later.position, triangles) == 0
        apart = later.position[below.count :, None] - later.position[None, : below.count]
        least = min(least, float(apart.norm(dim=-1).min()))
    assert 0.5 * 0.06 < least < 0.08


@pytest.mark.parametrize("broken", ["normal", "radius", "both"])
def test_patches_without_a_normal_or_a_size_end_finite(broken):
    """A disc without a normal or a radius touches nothing, or by the normal of the other; nothing becomes NaN."""

    def change(surface):
        every = torch.arange(len(surface.place)) % 3 == 0
        facing = torch.where(every[:, None], 0.0, surface.normal) if broken != "radius" else surface.normal
        radius = torch.where(every, 0.0, surface.radius) if broken != "normal" else surface.radius
        return replace(surface, normal=facing, radius=radius)

    solver, state = layers(3, 0.8 * THICKNESS, change=change, stiffness_damping=1e-3)
    later = march(solver, state, 0.03, frame=0.01)[-1]
    height = later.position[:, 2].reshape(3, -1)
    assert _finite(later)
    assert float((height[1:] - height[:-1]).mean()) > 0.85 * THICKNESS
