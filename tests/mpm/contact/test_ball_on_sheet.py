"""An elastic ball dropped on a held sheet: it dents the sheet and bounces, and does not pass through."""

import math

import pytest
import torch
from contacts import crossings, gaps, samples, sheet_triangles
from shared import double, solid

from gaussian_swaying import Box, Contact, MaterialPoints, MPMSolver, PinnedRegion
from gaussian_swaying.geometry.regions import Not
from gaussian_swaying.mpm.contact import Surface

from .bodies import march

RADIUS, SPACING, THICKNESS, SIDE = 0.1, 0.02, 0.01, 26
RINGS, AROUND = 11, 18
CENTRE = double([0.25, 0.25, 0.24])


def _ball():
    """Points of a ball, and rings of places on its surface: (P, 3), (RINGS x AROUND, 3) unit vectors."""
    axis = (torch.arange(20).double() - 9.5) * SPACING
    place = torch.cartesian_prod(axis, axis, axis)
    polar = (torch.arange(RINGS).double() + 0.5) * math.pi / RINGS
    turn = torch.arange(AROUND).double() * 2 * math.pi / AROUND
    a, b = torch.cartesian_prod(polar, turn).unbind(-1)
    out = torch.stack([a.sin() * b.cos(), a.sin() * b.sin(), -a.cos()], dim=-1)
    return place[place.norm(dim=-1) < RADIUS - 0.25 * SPACING], out


def _drop(friction=0.3, **settings):
    x = torch.arange(SIDE).double() * SPACING
    sheet = torch.cat([torch.cartesian_prod(x, x), torch.zeros(SIDE * SIDE, 1).double()], dim=-1)
    inner, out = _ball()
    ball = inner + CENTRE
    points = MaterialPoints.join(
        [
            solid(sheet, SPACING**2 * THICKNESS, 100.0, 4e4),
            solid(ball, SPACING**3, 200.0, 1e5),
        ]
    )
    skin = CENTRE + RADIUS * out
    nearest = torch.cdist(skin, ball).argmin(1)
    up = double([0.0, 0.0, 1.0]).expand(len(sheet), 3)
    radius = torch.cat([torch.full((len(sheet),), 0.75 * SPACING), torch.full((len(skin),), 1.3 * SPACING)]).double()
    surface = Surface(
        torch.cat([sheet, skin]),
        torch.cat([up, out]),
        radius,
        torch.full_like(radius, THICKNESS),
        torch.cat([sheet, ball[nearest]]),
        Contact(friction=friction),
    )
    side = (SIDE - 1) * SPACING
    rim = Not(Box([0.01, 0.01, None], [side - 0.01, side - 0.01, None]))
    solver = MPMSolver(2.2 * SPACING, boundaries=[PinnedRegion(rim, kind="hinge")], **settings)
    state = solver.init_state(points, surface=surface)
    number = len(sheet) + torch.arange(RINGS * AROUND).reshape(RINGS, AROUND)
    closed = torch.cat([number, number[:, :1]], dim=1)
    rings = sheet_triangles(RINGS, AROUND + 1)
    skin = closed.reshape(-1)[rings]
    return solver, state, (torch.cat([sheet_triangles(SIDE, SIDE), skin]), skin)


def _passed(place, triangles):
    whole, ball = triangles
    return crossings(place, whole) - crossings(place, ball)


@pytest.mark.parametrize("seconds", [0.24, pytest.param(0.48, marks=pytest.mark.slow)])
def test_a_ball_dropped_on_a_sheet_dents_it_and_bounces(seconds):
    """It falls 13 cm. Nothing passes through; energy does not grow; half a second later the ball has come back up."""
    solver, state, triangles = _drop(gravity=(0, 0, -9.8))
    count = SIDE * SIDE
    mass = solver.points.mass[count:]
    before = sum(float(part) for part in solver.energies(state).values())
    scale = 9.8 * float(mass.sum()) * 0.13
    heights, sheets, found = [], [], []
    for later in march(solver, state, seconds, frame=0.04):
        stage = solver.bound.contact
        place = samples(stage, later)[0]
        assert _passed(place, triangles) == 0
        found.append(gaps(stage, later))
        energy = sum(float(part) for part in solver.energies(later).values())
        assert energy < before + 0.02 * scale
        heights.append(float((mass * later.position[count:, 2]).sum() / mass.sum()))
        sheets.append(float(later.position[:count, 2].min()))
    found = torch.cat(found)
    assert len(found) > 2100 * seconds
    assert (found < 0.5).double().mean() <= 1e-3
    lowest = min(range(len(heights)), key=heights.__getitem__)
    assert sheets[lowest] < -RADIUS  # a deep dent
    if seconds > 0.4:
        assert max(heights[lowest:]) > heights[lowest] + 0.15  # and back up
