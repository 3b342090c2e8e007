"""Up, floor, what moves and where it is held, of things whose up axis, floor, object, pins and spacing are known."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from shared import seeded, unit, value_error
from small_scenes import guess, plain_cloud, started, together, turned_cloud
from things import AWAY, ball, block, guitar_on_a_stand, lamp, man, plant_in_a_pot, splat, tube

from gaussian_swaying.gaussians.hold import cord_heights, end_region, guess_hold
from gaussian_swaying.gaussians.measures import DIRECTIONS, Gaussians, corners, sheet_normal
from gaussian_swaying.geometry.regions import Box, Cylinder
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import suggest_spacing
from gaussian_swaying.suggestion.moves import given_region, suggest_threshold
from gaussian_swaying.suggestion.suggest import CELLS, CLOTH_E, QUALITIES, broad_side
from gaussian_swaying.suggestion.up import floor_mask, guess_up
from gaussian_swaying.wind.turbulence import LOOKS

UP = (0.0, 0.0, 1.0)
FLOOR, TRUNK, CROWN = slice(0, 1681), slice(1681, 1981), slice(1981, 2781)
TURNS = {"+z": (1, 0, 0, 0), "-z": (0, 1, 0, 0), "+x": (1, 0, 1, 0), "-x": (1, 0, -1, 0), "+y": (1, -1, 0, 0),
         "-y": (1, 1, 0, 0)}  # fmt: skip


def tree(floor=True, offset=5.0):
    """A floor of 2 x 2, a trunk of 0.1 x 0.1 x 0.8 on it, a crown of radius 0.35 at 1.1; z up, off the origin."""
    side = torch.linspace(-1, 1, 41)
    ground = torch.cartesian_prod(side, side, torch.zeros(1))
    draw = seeded(0)
    trunk = (torch.rand(300, 3, generator=draw) - 0.5) * torch.tensor([0.1, 0.1, 0.76]) + torch.tensor([0, 0, 0.43])
    sphere = unit(800, 3, generator=draw, dtype=torch.float32)
    crown = 0.35 * sphere * torch.rand(800, 1, generator=draw) ** (1 / 3) + torch.tensor([0, 0, 1.1])
    quats = torch.cat([torch.tensor([[1.0, 0, 0, 0]]).expand(1681, 4), torch.randn(1100, 4, generator=draw)])
    scales, logit = torch.tensor([0.03, 0.03, 0.003]).log(), math.log(9.0)
    cloud = plain_cloud(torch.cat([ground, trunk, crown]) + offset, scales, quats, logit)
    return cloud if floor else cloud.select(torch.arange(1681, 2781))


def gaussians(points, normals=None, weight=None):
    points = np.asarray(points, dtype=float)
    one = np.ones(len(points))
    normals = np.tile([0.0, 0, 1], (len(points), 1)) if normals is None else np.asarray(normals)
    return Gaussians(points, normals, points, one, one if weight is None else np.asarray(weight), points)


# ---- up and floor


@pytest.mark.parametrize("name", DIRECTIONS)
def test_floor_tells_up_whatever_the_axes(name):
    turn = torch.tensor(TURNS[name], dtype=torch.float32)
    found, ground = guess_up(Gaussians.of(turned_cloud(tree(), turn / turn.norm())))
    assert found.direction == DIRECTIONS[name]
    assert found.confidence != "low"
    assert ground[FLOOR].all()
    assert not ground[CROWN].any()


def test_without_a_floor_convention_decides_and_says_so():
    found, ground = guess_up(Gaussians.of(plain_cloud(torch.randn(500, 3) + 9)))
    assert found.confidence == "low"
    assert found.scores["+z"] == found.scores["-y"] == max(found.scores.values())
    assert not ground.any()


def test_origin_longest_side_and_base_are_evidence():
    column = torch.rand(2000, 3) * torch.tensor([1.0, 4.0, 1.0]) + torch.tensor([3.0, -4.0, 3.0])  # y from -4 to 0
    found, _ = guess_up(Gaussians.of(plain_cloud(column)))
    assert found.direction == (0, -1, 0)
    # 0.75 for y down, 1 for the origin, 1.5 for a side four times the next, 0.5 for a base, which the top is too
    assert found.scores["-y"] == pytest.approx(3.75)
    assert found.scores["+y"] == pytest.approx(2.5)
    height = torch.rand(3000, 1, generator=seeded(0)).sqrt()
    cone = torch.cat([0.6 * height * (torch.rand(3000, 2) - 0.5), 1 - height], -1) + 5  # it does not stand on its tip
    found, _ = guess_up(Gaussians.of(plain_cloud(cone)))
    assert found.scores["+z"] - found.scores["-z"] == pytest.approx(0.75 + 1 + 0.5)
    assert any("base" in reason for reason in found.reasons)


@pytest.mark.parametrize("change", ["none", "narrow", "table", "rough"])
def test_what_is_no_floor(change):
    means, normal = tree(offset=0.0).means.clone(), torch.tensor([0.0, 0, 1]).repeat(2781, 1)
    if change == "narrow":  # than what stands on it
        means[FLOOR] *= 0.2
    elif change == "table":  # something below it
        means[FLOOR, 2] += 0.8
    elif change == "rough":
        normal[FLOOR] = torch.tensor([0.6, 0.8, 0.0])
    assert floor_mask(gaussians(means, normal), UP).any() == (change == "none")


@pytest.mark.parametrize(
    ("floor", "below", "is_floor"),
    [
        (0.155, 0.0, True),  # at least 15 % of the area
        (0.145, 0.0, False),
        (0.948, 0.0, True),  # something above it: at least 5 %
        (0.952, 0.0, False),
        (0.5, 0.029, True),  # almost nothing below it: at most 3 %
        (0.5, 0.031, False),
    ],
)
def test_a_floor_has_its_share_of_the_area(floor, below, is_floor):
    """A level plate of 2 x 2, an upright thing on it, and bits below it; the rest of the area is the thing's."""
    side, high = torch.linspace(-1, 1, 21), torch.linspace(-0.2, 0.2, 5)
    plate = torch.cartesian_prod(side, side, torch.zeros(1))
    thing, bits = torch.cartesian_prod(high, high, torch.linspace(0.2, 1, 9)), plate[::16] - torch.tensor([0, 0, 0.3])
    count, shares = [len(plate), len(thing), len(bits)], np.array([floor, 1 - floor - below, below])
    normals = np.repeat([[0.0, 0, 1], [1, 0, 0], [1, 0, 0]], count, axis=0)
    found = floor_mask(gaussians(torch.cat([plate, thing, bits]), normals, np.repeat(3.7 * shares / count, count)), UP)
    assert np.array_equal(found, np.repeat([is_floor, False, is_floor], count))  # what lies below is no object


# ---- what moves


def test_region_leaves_out_floor_and_specks():
    cloud = tree()
    specks = torch.tensor([[0.3, 0.3, 0.3], [-0.3, -0.3, 0.35], [0.8, 0.8, 2.5]]) + 5.0  # two in the box, one above
    extra = plain_cloud(specks.repeat_interleave(4, 0) + 0.002 * torch.randn(12, 3), -5.0, logit=math.log(9.0))
    both = together(cloud, extra)
    found = guess(both)
    assert found.up.direction == (0, 0, 1)
    assert found.hold.name == "bottom"
    assert found.moving.specks == 12
    assert len(found.moving.holes) == 2
    simulated = found.moving.simulated
    assert simulated[CROWN].all()
    assert not simulated[FLOOR].any()
    assert not simulated[2781:].any()
    assert simulated[TRUNK].mean() > 0.9  # the foot lies in the layer of the floor
    # the region of the configuration picks the same Gaussians
    assert np.array_equal(found.moving.region.contains(both.means), simulated)
    pinned = found.pin.contains(both.means).numpy() & simulated  # the foot of the trunk
    assert pinned[TRUNK].any()
    assert not pinned[CROWN].any()


def test_too_little_is_refused():
    with value_error("too few for an object"):
        guess(tree().select(torch.arange(10)))
    with value_error(r"box of `--region` contains 0 Gaussians.*splat spans"):
        given_region(Gaussians.of(tree()), [90, 90, 90], [91, 91, 91])
    for points in (torch.ones(50, 3), (torch.arange(60) % 2).float()[:, None].expand(60, 3)):  # at one place, or two
        with value_error("are at one point"):
            guess(plain_cloud(points))


@pytest.mark.parametrize(
    ("weight", "threshold"),
    [([96.0, 2, 1, 1], 0.1), ([90.0, 6, 3, 1], 0.05), ([90.0, 3, 6, 1], 0.02), ([50.0, 0, 0, 50], 0.0)],
)
def test_threshold_keeps_the_visible_area(weight, threshold):
    some = dataclasses.replace(gaussians(torch.zeros(4, 3), weight=weight), opacity=np.array([0.5, 0.07, 0.03, 0.005]))
    assert suggest_threshold(some) == threshold


# ---- numbers


def test_flag_has_known_up_pins_region_and_spacing():
    found = guess(FlagScene(spacing=0.05).generate())
    assert (found.up.direction, found.up.confidence) == ((0, 0, 1), "medium")
    assert found.moving.region is None  # one sheet and nothing else
    assert found.moving.simulated.sum() == 24 * 16
    assert (found.hold.name, found.hold.direction) == ("side", (-1, 0, 0))  # the pole
    assert found.sheet
    # 24 columns span 1.15 m, which become 1 m: twice their distance is coarser than 1/24 m
    assert found.spacing == pytest.approx(0.05 / 1.15, rel=1e-4)
    assert found.dx == 0.087
    # one and a half cells from the 0.5 % that lie farthest out (here the first column)
    assert isinstance(found.pin, Box)
    assert found.pin.max[0] == pytest.approx(0.025 + 1.5 * 0.087 * 1.15, abs=1e-3)
    assert found.pin.max[1:] == (math.inf, math.inf)
    # from the pole along the flag, a little onto it
    along = LOOKS["breeze"].speed * np.array([math.cos(0.25), math.sin(0.25)])
    assert np.abs(found.flow[:2]) == pytest.approx(along, abs=0.01)
    assert (found.youngs_modulus, found.falls) == (CLOTH_E, True)


def test_only_cloth_and_what_falls_has_weight():
    for hold, falls in (("bottom", False), ("top", False), ("none", True)):
        found = guess(tree(), hold=hold)
        assert found.falls == falls
        assert math.hypot(*found.flow) == pytest.approx(LOOKS["breeze"].speed, abs=0.01)


def test_a_quality_is_a_grid_and_nothing_else():
    cloud = FlagScene(spacing=0.015).generate()
    found = {name: guess(cloud, quality=name) for name in QUALITIES}
    assert {name: one.dx for name, one in found.items()} == {"draft": 0.062, "normal": 0.042, "fine": 0.025}
    assert found["fine"].dx == pytest.approx(2 * found["fine"].spacing, rel=0.02)  # its Gaussians are too far apart
    for one in found.values():
        assert (one.pin.max, one.flow, one.size) == (
            found["normal"].pin.max,
            found["normal"].flow,
            found["normal"].size,
        )
    with value_error("Expected `--quality` to be one of draft, normal, fine, but got 'best'"):
        guess(cloud, quality="best")


def test_given_values_replace_guesses():
    cloud = FlagScene(spacing=0.05).generate()
    found = guess(cloud, up="+x", hold="top", region=([0, -1, 0], [0.6, 1, 1]), longest_side=2.0, wind=3.0)
    assert found.up.direction == found.hold.direction == (1, 0, 0)
    assert found.up.confidence == found.hold.confidence == "given"
    assert found.moving.simulated.sum() == 12 * 16
    assert found.pin.min[0] > 0.3
    assert max(found.size) == pytest.approx(2.0)
    assert math.hypot(*found.flow) == pytest.approx(3.0, abs=0.01)
    assert guess(cloud, up=[0, 0, 2], hold="none").pin is None
    assert guess(cloud, hold="+x").pin.min[0] > 1


def test_holes_between_large_gaussians_are_filled_without_asking(tmp_path):
    cloud = FlagScene(spacing=0.05).generate()
    sparse = dataclasses.replace(cloud, scales=cloud.scales + math.log(4)).select(torch.arange(len(cloud)) % 5 == 0)
    scene = started(dataclasses.replace(guess(sparse), dx=0.06), sparse, tmp_path).scene
    assert scene.further > 0.5 * len(sparse)


def test_measures():
    points = torch.rand(1000, 3).double().numpy()
    points[0] = 1e6  # a far speck
    assert corners(points).max() <= 1
    plate = np.random.default_rng(0).random((500, 3)) * [1.0, 0.02, 2.0]
    assert sheet_normal(plate).tolist() == [0, 1, 0]
    assert sheet_normal(points[1:]) is None
    assert abs(broad_side(plate)) == pytest.approx(90, abs=2)  # seen along y
    cos, sin = math.cos(math.pi / 6), math.sin(math.pi / 6)
    assert broad_side(plate @ [[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) == pytest.approx(-60, abs=2)
    assert (suggest_spacing(1.0, 0.001, 24), suggest_spacing(1.0, 0.1, 24)) == (0.042, 0.2)
    with value_error("longest_side"):
        suggest_spacing(0.0, 0.1, 24)


# ---- where it is held


def test_end_region_of_a_tilted_axis_holds_that_end():
    points, axis = 2 * np.random.default_rng(0).random((2000, 3)) - 1, np.array([0.6, 0.0, 0.8])
    region, along = end_region(points, axis.tolist(), 0.05), points @ axis
    assert isinstance(region, Cylinder)
    start = np.sort(along)[round(0.995 * 1999)] - max(0.06 * np.ptp(along), 1.5 * 0.05)
    held = region.contains(torch.from_numpy(points)).numpy()
    sure = np.abs(along - start) > 1e-3  # coordinates are rounded to a hundredth of a cell
    assert held.any()
    assert np.array_equal(held[sure], (along >= start)[sure])


def ground(low=-0.06, half=1.0, step=0.05, move=(0.0, 0.0, 0.0)):
    side = torch.arange(-half, half + step / 2, step)
    means = torch.cartesian_prod(side, side, torch.tensor([low])) + torch.tensor(move)
    return plain_cloud(means, torch.tensor([0.6 * step, 0.6 * step, 0.002]).log(), logit=2.0)


def held(cloud):
    own = Gaussians.of(cloud)
    return guess_hold(own, UP, np.ptp(own.means, axis=0).max() / CELLS)


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
    assert (found.name, found.confidence) == (end, confidence), found
    assert found.direction == ((0, 0, 1) if end == "top" else (0, 0, -1))


@pytest.mark.parametrize("thing", [man, guitar_on_a_stand])
def test_origin_at_the_feet_makes_it_sure(thing):
    found = held(splat(*thing()))
    assert (found.name, found.confidence) == ("bottom", "high")
    assert "the origin lies at its lower end" in found.reasons[0]
    top = float(splat(*thing()).means[:, 2].amax())
    found = held(splat(*thing(), move=(0.0, 0.0, -top)))
    assert found.confidence == "low"  # the origin at the upper end speaks against the base
    assert found.scores["top"] == 1.0


def test_flag_is_held_at_its_pole_only_if_the_origin_is_there():
    flag = FlagScene(spacing=0.05).generate()
    found = guess(flag).hold
    assert (found.name, found.direction, found.confidence) == ("side", (-1, 0, 0), "medium")
    lost = held(dataclasses.replace(flag, means=flag.means + torch.tensor(AWAY)))
    assert (lost.name, lost.confidence) == ("top", "low")
    assert lost.options == ("top", "-x")  # the next best is one of its upright sides


def test_what_leans_or_ends_beside_the_centre_is_no_cord():
    """The guitar's neck is as thin as a cord, and leans; a lamp with its cord at the rim would hang askew."""
    assert "cord" not in held(splat(*guitar_on_a_stand())).reasons[0]
    bulb, *rest = lamp()
    askew = [part + torch.tensor([0.11, 0.0, 0.0]) for part in rest]
    assert held(splat(bulb, *askew, move=AWAY)).scores["top"] == 0


def test_floor_holds_what_touches_it_and_not_what_hangs_over_it():
    move = (3.0, 4.0, 0.0)
    standing = guess(together(splat(*man(), move=move), ground(move=move))).hold
    assert standing.name == "bottom"
    assert standing.scores["bottom"] == 4.5  # 2 for the floor, 1 the origin in its plane, 1 the base, 0.5
    over = guess(together(splat(*lamp(), move=(0.0, 0.0, 0.5)), ground()), up="+z")
    assert over.ground.any()
    assert over.hold.name == "top"
    assert "left out" not in over.hold.reasons[0]


def test_what_a_region_cuts_off_above_holds_it_there():
    whole = splat(tube([0.0, 0.0, 0.0], [0.0, 0.0, 2.0], 0.3, 6000), move=AWAY)
    below = guess(whole, up="+z", region=([2.0, 3.0, 4.9], [4.0, 5.0, 6.0])).hold
    assert (below.name, below.scores["top"]) == ("top", 2.0)
    above = guess(whole, up="+z", region=([2.0, 3.0, 6.0], [4.0, 5.0, 7.1])).hold
    assert (above.name, above.confidence) == ("bottom", "high")


def test_photos_from_below_say_that_it_hangs():
    angle = np.arange(0, 6, 0.5)
    one, ring = gaussians(ball([0.0, 0.0, 3.0], 0.5)), np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0 * angle], 1)
    assert guess_hold(one, UP, 0.05).name == "bottom"
    hung = guess_hold(one, UP, 0.05, eyes=ring + np.array([0.0, 0.0, 1.5]))
    assert (hung.name, hung.scores["top"]) == ("top", 1.0)
    assert guess_hold(one, UP, 0.05, eyes=ring + np.array([0.0, 0.0, 4.0])).scores["bottom"] == 1.0
    wall = guess_hold(one, UP, 0.05, wall=(0.0, 1.0, 0.0))
    assert (wall.name, wall.direction) == ("side", (0, 1, 0))


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
    z = np.repeat(np.linspace(0, 3, 601), 4)
    edges = np.tile([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], (601, 1))
    bars = np.c_[3 * np.where(z > 1.2, cord, body)[:, None] * edges, z]
    assert (cord_heights(gaussians(bars), np.array(UP)) is not None) == is_cord
