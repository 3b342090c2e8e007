"""A tree of wood and leaves, and the frame of beams beside it."""

import math

import numpy as np
import pytest
import torch
from bench.problems.settings import Settings
from bench.problems.trees import (
    WOOD_DENSITY,
    WOOD_E,
    Piece,
    damping,
    frame_modes,
    frequency,
    mode_damping,
    swaying,
    tree,
)


def test_the_frame_has_the_frequency_of_a_cantilever():
    """In both directions; and a piece that goes on where the first one ends makes it as stiff as one of its length."""
    exact = 3.516015 / 10**2 * math.sqrt(WOOD_E * 0.2**2 / 16 / WOOD_DENSITY)
    whole = frame_modes([Piece((0, 0, 0), (0, 0, 10), (0.2, 0.2))], parts=6)[0]
    assert whole[:2] == pytest.approx([exact, exact], rel=2e-3)
    halves = [Piece((0, 0, 0), (0, 0, 5), (0.2, 0.2)), Piece((0, 0, 5), (0, 0, 10), (0.2, 0.2))]
    assert frame_modes(halves, parts=6)[0][0] == pytest.approx(whole[0], rel=5e-3)


def test_leaves_make_it_slower():
    shape = {"height": 10.0, "branches": 3}
    bare, leafy = (frame_modes(tree(area, **shape), parts=4)[0][0] for area in (0.0, 100.0))
    assert leafy < 0.9 * bare


def test_a_small_tree_sways_as_its_frame():
    """On a coarse grid; the errors on finer ones are on the page about nature."""
    found = frequency(leaf_area=30.0, dx=0.5, height=6.0, branches=2)
    assert abs(found["error"]) < 0.15
    assert found["leaves"] == pytest.approx(6.0, rel=0.05)


def test_the_mode_alone_loses_what_a_linear_damper_and_a_quadratic_one_take():
    """An amplitude falls as da/dt = -r a / 2 - 4 d omega a^2 / (3 pi) in air at rest, with the drag d over the mass."""
    one = swaying(tree(50.0, height=6.0, branches=2), 1.0, Settings())
    rate, pull = 0.02 * one.omega, 0.2
    frame = 2 * math.pi / one.omega / 32
    speeds = mode_damping(one, rate, pull, 0.0, frame, 64, steps=8).numpy()
    leaf = one.force.area > 0
    through = (one.force.normal * one.shape)[leaf].sum(-1).square() * one.shape[leaf].norm(dim=-1)
    mass = float((one.points.mass[:, None] * one.shape.square()).sum())
    drag = 0.5 * 1.225 * 1.2 * float((one.force.area[leaf] * through).sum()) / mass
    a = pull
    for _ in range(2000):
        a -= (0.5 * rate * a + 4 * drag * one.omega * a * a / (3 * math.pi)) * 64 * frame / 2000
    assert np.abs(speeds[-8:]).max() / one.omega == pytest.approx(a, rel=0.02)
    assert a < 0.97 * pull * math.exp(-0.5 * rate * 64 * frame)  # the leaves take their part


def test_damping_on_a_coarse_grid_is_that_of_the_mode():
    found = damping(30.0, pull=0.2, dx=1.0, periods=1.0, height=6.0, branches=1)
    assert found["exact"] > 0.051
    assert abs(found["error"]) < 0.3


def test_the_points_have_the_mass_of_the_tree():
    one = swaying(tree(20.0, height=6.0, branches=1), 0.5, Settings(dtype=torch.float64))
    leaves = one.points.youngs_modulus != WOOD_E
    assert float(one.points.mass[leaves].sum()) == pytest.approx(0.2 * 20.0, rel=0.1)
    assert float(one.force.area.sum()) == pytest.approx(20.0, rel=0.1)
    assert 0 < one.share < 1
