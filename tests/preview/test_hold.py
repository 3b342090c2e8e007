"""Whether things stand or hang, on stand-ins made of a few tubes, balls and plates: surfaces only, z up."""

import dataclasses
import math

import pytest
import torch
from small_scenes import plain_cloud, together
from things import AWAY, ball, block, guitar_on_a_stand, lamp, man, plant_in_a_pot, splat, tube

from gaussian_swaying.preview.hold import cord_heights, guess_hold
from gaussian_swaying.preview.suggest import CELLS, suggest, visible_weight
from gaussian_swaying.scenes.procedural import FlagScene


def ground(low=-0.06, half=1.0, step=0.05):
    """A level plate of flat Gaussians, as a splat."""
    side = torch.arange(-half, half + step / 2, step)
    x, y = torch.meshgrid(side, side, indexing="ij")
    means = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((x.numel(),), low)], -1)
    return plain_cloud(means, torch.tensor([0.6 * step, 0.6 * step, 0.002]).log(), logit=2.0)


def flag(move=(0.0, 0.0, 0.0)):
    """The generated flag, its pole at x = 0."""
    cloud = FlagScene(spacing=0.05).generate()
    return dataclasses.replace(cloud, means=cloud.means + torch.tensor(move))


def held(cloud):
    """Where a splat with z up is held, all of it taken as the object."""
    cell = float((cloud.means.amax(0) - cloud.means.amin(0)).amax()) / CELLS
    return guess_hold(cloud.means, visible_weight(cloud), (0.0, 0.0, 1.0), cell)


@pytest.mark.parametrize(
    ("thing", "end", "confidence"),
    [
        (man(), "bottom", "medium"),
        (guitar_on_a_stand(), "bottom", "medium"),
        (plant_in_a_pot(), "bottom", "medium"),
        ([block([0.0, 0.0, 0.0], [1.0, 0.8, 0.6])], "bottom", "medium"),
        ([tube([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.4, 1500, 0.02)], "bottom", "medium"),  # a cone, as a fir
        ([tube([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.02, 1500, 0.4)], "bottom", "medium"),  # on its tip, as on a stalk
        (lamp(), "top", "medium"),
        (lamp("cone"), "top", "medium"),
        ([block([0.0, 0.0, 0.0], [1.0, 0.01, 1.6])], "top", "low"),  # a curtain
        ([ball([0.0, 0.0, 0.0], 1.0)], "bottom", "low"),
        ([block([0.0, 0.0, 0.0], [2.0, 0.01, 1.4]), block([0.8, 0.0, 0.5], [1.2, 0.5, 1.0])], "bottom", "low"),
    ],
)
def test_things_stand_or_hang(thing, end, confidence):
    found = held(splat(*thing, move=AWAY))
    assert (found.end, found.confidence) == (end, confidence), found
    assert found.direction == ((0, 0, 1) if end == "top" else (0, 0, -1))


@pytest.mark.parametrize("thing", [man, guitar_on_a_stand])
def test_origin_at_the_feet_makes_it_sure(thing):
    found = held(splat(*thing()))
    assert (found.end, found.confidence) == ("bottom", "high")
    assert "the origin lies at its lower end" in found.reason
    hung = splat(*thing())
    top = float(hung.means[:, 2].amax())
    found = held(splat(*thing(), move=(0.0, 0.0, -top)))
    assert found.confidence == "low"  # the origin at the upper end speaks against the base
    assert found.scores["top"] == 1.0


def test_flag_is_held_at_its_pole_only_if_the_origin_is_there():
    found = suggest(flag()).hold
    assert (found.end, found.direction, found.confidence) == ("side", (-1, 0, 0), "medium")
    lost = held(flag(AWAY))
    assert (lost.end, lost.confidence) == ("top", "low")
    assert lost.options == ("top", "-x")  # the next best is one of its upright sides


def test_what_leans_or_ends_beside_the_centre_is_no_cord():
    """The guitar's neck is as thin as a cord, and leans; a lamp with its cord at the rim would hang askew."""
    assert "cord" not in held(splat(*guitar_on_a_stand())).reason
    askew = lamp()
    askew[1] = askew[1] + torch.tensor([0.11, 0.0, 0.0])
    askew[2] = askew[2] + torch.tensor([0.11, 0.0, 0.0])
    assert held(splat(*askew, move=AWAY)).scores["top"] == 0


def test_floor_holds_what_touches_it_and_not_what_hangs_over_it():
    standing = suggest(together(splat(*man(), move=(3.0, 4.0, 0.0)), dataclasses.replace(ground(), means=(
        ground().means + torch.tensor([3.0, 4.0, 0.0]))))).hold  # fmt: skip
    assert standing.end == "bottom"
    assert standing.scores["bottom"] == 4.5  # 2 for the floor, 1 the origin in its plane, 1 the base, 0.5
    over = suggest(together(splat(*lamp(), move=(0.0, 0.0, 0.5)), ground()), "+z")
    assert bool(over.up.ground.any())
    assert over.hold.end == "top"
    assert "left out" not in over.hold.reason


def test_what_a_region_cuts_off_above_holds_it_there():
    whole = splat(tube([0.0, 0.0, 0.0], [0.0, 0.0, 2.0], 0.3, 6000), move=AWAY)
    below = suggest(whole, "+z", region=([2.0, 3.0, 4.9], [4.0, 5.0, 6.0])).hold
    assert (below.end, below.scores["top"]) == ("top", 2.0)
    above = suggest(whole, "+z", region=([2.0, 3.0, 6.0], [4.0, 5.0, 7.1])).hold
    assert (above.end, above.confidence) == ("bottom", "high")


def test_photos_from_below_say_that_it_hangs():
    points, weight = ball([0.0, 0.0, 3.0], 0.5), torch.ones(600)
    ring = torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in torch.arange(0, 6, 0.5).tolist()]) * 3
    up = (0.0, 0.0, 1.0)
    assert guess_hold(points, weight, up, 0.05).end == "bottom"
    hung = guess_hold(points, weight, up, 0.05, eyes=ring + torch.tensor([0.0, 0.0, 1.5]))
    assert (hung.end, hung.scores["top"]) == ("top", 1.0)
    stands = guess_hold(points, weight, up, 0.05, eyes=ring + torch.tensor([0.0, 0.0, 4.0]))
    assert stands.scores["bottom"] == 1.0
    wall = guess_hold(points, weight, up, 0.05, wall=(0.0, 1.0, 0.0))
    assert (wall.end, wall.direction) == ("side", (0, 1, 0))


@pytest.mark.parametrize(
    ("body", "cord", "is_cord"),
    [
        (0.5, 0.039, True),  # thinner than 0.04 of the length
        (0.5, 0.041, False),
        (0.1, 0.024, True),  # and than a quarter of the widest part
        (0.1, 0.026, False),
    ],
)
def test_a_cord_is_thin_for_the_length_and_for_what_hangs_on_it(body, cord, is_cord):
    """Two upright square bars, the upper one thin, 3 long together; of each, only the four edges."""
    corners = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], dtype=torch.float64)
    height = torch.linspace(0, 3, 601, dtype=torch.float64)
    width = 3 * torch.where(height > 1.2, cord, body)
    points = torch.cat([(width[:, None, None] * corners), height[:, None, None].expand(-1, 4, 1)], -1).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    found = cord_heights(points, torch.ones(len(points), dtype=torch.float64), up)
    assert (found is not None) == is_cord
