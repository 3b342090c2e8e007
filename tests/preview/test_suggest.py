"""Guesses about a splat, against scenes whose up axis, floor, object, pins and spacing are known."""

import dataclasses
import itertools
import math

import pytest
import torch
import yaml
from shared import unit
from small_scenes import plain_cloud, started, together, turned_cloud

from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.geometry.regions import Box, Cylinder
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.preview.hold import end_region
from gaussian_swaying.preview.kinds import KINDS
from gaussian_swaying.preview.shape import DIRECTIONS, bounds, sheet_normal
from gaussian_swaying.preview.starter import starter_yaml
from gaussian_swaying.preview.suggest import (
    CLOTH_E,
    MOST_CELLS,
    QUALITIES,
    SHELL_E,
    broad_side,
    finest_spacing,
    gaussian_statistics,
    given_region,
    of_material,
    suggest,
    suggest_threshold,
    visible_weight,
)
from gaussian_swaying.preview.up import floor_mask, guess_up
from gaussian_swaying.scenes.leaves import LeavesScene
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import suggest_spacing
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.turbulence import LOOKS

VISIBLE = math.log(9.0)
"""Logit of an opacity of 0.9."""
FLOOR, TRUNK, CROWN = slice(0, 1681), slice(1681, 1981), slice(1981, 2781)


def turned(cloud, name):
    """A splat with z up turned so that an axis is up, by a permutation of axes and signs."""
    half = math.sqrt(0.5)
    turns = {
        "+z": [1.0, 0, 0, 0],
        "-z": [0, 1.0, 0, 0],
        "+x": [half, 0, half, 0],
        "-x": [half, 0, -half, 0],
        "+y": [half, -half, 0, 0],
        "-y": [half, half, 0, 0],
    }
    return turned_cloud(cloud, torch.tensor(turns[name]))


def tree(floor=True, offset=5.0):
    """A floor of 2 x 2, a trunk of 0.1 x 0.1 x 0.8 on it, a crown of radius 0.35 at 1.1; z up, off the origin."""
    side = torch.linspace(-1, 1, 41)
    x, y = torch.meshgrid(side, side, indexing="ij")
    ground = torch.stack([x.reshape(-1), y.reshape(-1), torch.zeros(1681)], -1)
    draw = torch.Generator().manual_seed(0)
    trunk = (torch.rand(300, 3, generator=draw) - 0.5) * torch.tensor([0.1, 0.1, 0.76]) + torch.tensor([0, 0, 0.43])
    ball = unit(800, 3, generator=draw, dtype=torch.float32)
    crown = 0.35 * ball * torch.rand(800, 1, generator=draw) ** (1 / 3) + torch.tensor([0, 0, 1.1])
    scales = torch.tensor([0.03, 0.03, 0.003]).log()
    quats = torch.cat([torch.tensor([[1.0, 0, 0, 0]]).expand(1681, 4), torch.randn(1100, 4, generator=draw)])
    cloud = plain_cloud(torch.cat([ground, trunk, crown]) + offset, scales, quats, VISIBLE)
    return cloud if floor else cloud.select(torch.arange(1681, 2781))


def up_of(cloud):
    return guess_up(cloud.means, smallest_axis_normal(cloud.quats, cloud.scales), visible_weight(cloud))


# ---- the flag


def test_flag_has_known_up_pins_region_and_spacing():
    found = suggest(FlagScene(spacing=0.05).generate())
    assert found.up.direction == (0, 0, 1)
    assert found.up.confidence == "medium"
    assert found.region.region() is None  # one sheet and nothing else
    assert int(found.region.simulated.sum()) == 24 * 16
    assert found.hold.end == "side"
    assert found.hold.direction == (-1, 0, 0)  # the pole
    assert found.sheet
    # 24 columns span 1.15 m, which become 1 m: twice their distance is coarser than 1/24 m
    assert found.spacing == pytest.approx(0.05 / 1.15, rel=1e-4)
    assert found.dx == 0.087
    # one and a half cells from the 0.5 % that lie farthest out (here the first column)
    assert isinstance(found.pin, Box)
    assert found.pin.max[0] == pytest.approx(0.025 + 1.5 * 0.087 * 1.15, abs=1e-3)
    assert found.pin.max[1:] == (math.inf, math.inf)
    # from the pole along the flag, a little onto it
    assert found.flow[0] == pytest.approx(LOOKS["breeze"].speed * math.cos(0.25), abs=0.01)
    assert abs(found.flow[1]) == pytest.approx(LOOKS["breeze"].speed * math.sin(0.25), abs=0.01)


def test_holes_between_large_gaussians_are_filled_without_asking(tmp_path):
    """A sheet of few, huge Gaussians."""
    cloud = FlagScene(spacing=0.05).generate()
    few = torch.arange(len(cloud)) % 5 == 0
    sparse = dataclasses.replace(cloud, scales=cloud.scales + math.log(4)).select(few)
    scene = started(dataclasses.replace(suggest(sparse), dx=0.06), sparse, tmp_path).scene
    assert "particle_spacing" not in (tmp_path / "starter.yaml").read_text()
    assert scene.further > 0.5 * len(sparse)


def test_a_quality_is_a_grid_and_nothing_else():
    cloud = FlagScene(spacing=0.015).generate()
    found = {name: suggest(cloud, quality=name) for name in QUALITIES}
    assert {name: one.dx for name, one in found.items()} == {"draft": 0.062, "normal": 0.042, "fine": 0.025}
    assert found["fine"].dx == pytest.approx(2 * found["fine"].spacing, rel=0.02)  # its Gaussians are too far apart
    assert suggest(cloud).dx == found["normal"].dx
    for name, one in found.items():
        assert one.quality == name
        same = dataclasses.replace(one, dx=0.042, quality="normal")
        assert starter_yaml(same, "flag.ply") == starter_yaml(found["normal"], "flag.ply")
        text = starter_yaml(one, "flag.ply")
        assert f"every number may be changed. Quality: {name}.\n" in text
        assert f"# m; quality {name}: " in text
        assert yaml.safe_load(text)["solver"]["dx"] == one.dx
    assert finest_spacing(found["normal"]) == found["fine"].dx
    assert finest_spacing(dataclasses.replace(found["normal"], spacing=1e-4)) == float(f"{1 / MOST_CELLS:.2g}")
    with pytest.raises(ValueError, match="Expected `--quality` to be one of draft, normal, fine, but got 'best'"):
        suggest(cloud, quality="best")


def test_given_values_replace_guesses():
    cloud = FlagScene(spacing=0.05).generate()
    found = suggest(cloud, up="+x", hold="top", region=([0, -1, 0], [0.6, 1, 1]), longest_side=2.0, speed=3.0)
    assert found.up.direction == (1, 0, 0)
    assert found.up.confidence == found.hold.confidence == "given"
    assert found.hold.direction == (1, 0, 0)
    assert int(found.region.simulated.sum()) == 12 * 16
    assert found.pin.min[0] > 0.3
    assert max(found.size) == pytest.approx(2.0)
    assert math.hypot(*found.flow) == pytest.approx(3.0, abs=0.01)
    assert suggest(cloud, up=[0, 0, 2], hold="none").pin is None
    assert suggest(cloud, hold="+x").pin.min[0] > 1


# ---- up and floor


@pytest.mark.parametrize("name", DIRECTIONS)
def test_floor_tells_up_whatever_the_axes(name):
    cloud = turned(tree(), name)
    found = up_of(cloud)
    assert found.direction == DIRECTIONS[name]
    assert found.confidence != "low"
    assert bool(found.ground[FLOOR].all())
    assert not bool(found.ground[CROWN].any())


def test_without_a_floor_convention_decides_and_says_so():
    ball = plain_cloud(torch.randn(500, 3) + 9)
    found = up_of(ball)
    assert found.confidence == "low"
    assert found.scores["+z"] == found.scores["-y"] == max(found.scores.values())
    assert not bool(found.ground.any())


def test_origin_at_the_lower_end_and_longest_side_are_evidence():
    column = torch.rand(2000, 3) * torch.tensor([1.0, 4.0, 1.0]) + torch.tensor([3.0, -4.0, 3.0])  # y from -4 to 0
    found = up_of(plain_cloud(column))
    assert found.direction == (0, -1, 0)
    # 0.75 for y down, 1 for the origin, 1.5 for a side four times the next, 0.5 for a base, which the top is too
    assert found.scores["-y"] == pytest.approx(3.75)
    assert found.scores["+y"] == pytest.approx(2.5)


def test_a_base_tells_which_end_is_down():
    """A cone, off the origin: it does not stand on its tip."""
    height = torch.rand(3000, 1, generator=torch.Generator().manual_seed(0)).sqrt()
    cone = torch.cat([0.6 * height * (torch.rand(3000, 2) - 0.5), 1 - height], -1) + 5
    found = up_of(plain_cloud(cone))
    assert found.scores["+z"] - found.scores["-z"] == pytest.approx(0.75 + 1 + 0.5)
    assert any("base" in reason for reason in found.reasons)


@pytest.mark.parametrize("change", ["narrow", "table", "rough"])
def test_what_is_no_floor(change):
    means, normal = tree(offset=0.0).means.clone(), torch.tensor([0.0, 0, 1]).repeat(2781, 1)
    assert bool(floor_mask(means, normal, torch.ones(2781), (0, 0, 1)).any())
    if change == "narrow":  # than what stands on it
        means[FLOOR] *= 0.2
    elif change == "table":  # something below it
        means[FLOOR, 2] += 0.8
    else:
        normal[FLOOR] = torch.tensor([0.6, 0.8, 0.0])
    assert not bool(floor_mask(means, normal, torch.ones(2781), (0, 0, 1)).any())


# ---- region


def test_region_leaves_out_floor_and_specks():
    cloud = tree()
    specks = torch.tensor([[0.3, 0.3, 0.3], [-0.3, -0.3, 0.35], [0.8, 0.8, 2.5]]) + 5.0  # two in the box, one above
    extra = plain_cloud(specks.repeat_interleave(4, 0) + 0.002 * torch.randn(12, 3), -5.0, logit=VISIBLE)
    both = together(cloud, extra)
    found = suggest(both)
    assert found.up.direction == (0, 0, 1)
    assert found.hold.end == "bottom"
    assert found.region.specks == 12
    assert len(found.region.holes) == 2
    simulated = found.region.simulated
    assert bool(simulated[CROWN].all())
    assert not bool(simulated[FLOOR].any())
    assert not bool(simulated[2781:].any())
    assert float(simulated[TRUNK].double().mean()) > 0.9  # the foot lies in the layer of the floor
    # what the region of the configuration picks is what is said
    region = found.region.region()
    assert torch.equal(region.contains(both.means), simulated)
    # the pinned end is the foot of the trunk
    pinned = found.pin.contains(both.means) & simulated
    assert bool(pinned[TRUNK].any())
    assert not bool(pinned[CROWN].any())


def test_too_little_above_the_floor_is_refused():
    cloud = tree().select(torch.arange(0, 1700))
    with pytest.raises(ValueError, match="too few for an object"):
        suggest(cloud.select(torch.arange(10)))
    with pytest.raises(ValueError, match=r"box of `--region` contains 0 Gaussians.*splat spans"):
        given_region(cloud.means, torch.ones(1700), torch.ones(1700), [90, 90, 90], [91, 91, 91])
    with pytest.raises(ValueError, match="are at one point"):
        suggest(plain_cloud(torch.ones(50, 3)))


def test_threshold_keeps_the_visible_area():
    opacity = torch.tensor([0.5, 0.07, 0.03, 0.005])
    assert suggest_threshold(opacity, torch.tensor([96.0, 2, 1, 1])) == 0.1
    assert suggest_threshold(opacity, torch.tensor([90.0, 6, 3, 1])) == 0.05
    assert suggest_threshold(opacity, torch.tensor([90.0, 3, 6, 1])) == 0.02
    assert suggest_threshold(opacity, torch.tensor([50.0, 0, 0, 50])) == 0.0


def test_connected_parts_against_a_search():
    points = torch.rand(120, 3)
    part = connected_parts(points, 0.1)
    cell = ((points.double() - points.amin(0).double()) / 0.1).floor().long()
    label = list(range(120))  # the definition: cells that touch are connected
    for _ in range(120):
        for i, j in itertools.combinations(range(120), 2):
            if label[i] != label[j] and bool(((cell[i] - cell[j]).abs() <= 1).all()):
                label[i] = label[j] = min(label[i], label[j])
        if all(
            label[i] == label[j]
            for i, j in itertools.combinations(range(120), 2)
            if bool(((cell[i] - cell[j]).abs() <= 1).all())
        ):
            break
    label = torch.tensor(label)
    assert 1 < len(label.unique()) < 120
    assert torch.equal(part[:, None] == part, label[:, None] == label)


def test_a_long_chain_is_one_part():
    chain = torch.arange(3000.0)[:, None] * torch.tensor([1.0, 0.3, -0.2])
    assert int(connected_parts(chain, 1.01).max()) == 0
    assert int(connected_parts(chain, 0.45).max()) > 0


def test_a_stray_point_far_away_does_not_join_the_parts():
    points = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [1.0, 0, 0], [-1e5, 0, 0]])
    assert connected_parts(points, 0.02).tolist() == [1, 1, 2, 0]


# ---- pins


def test_end_region_of_a_tilted_axis_holds_that_end():
    points = torch.rand(2000, 3, dtype=torch.float64) * 2 - 1
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    region = end_region(points, axis.tolist(), 0.05)
    assert isinstance(region, Cylinder)
    along = points @ axis
    solid = along.sort().values[round(0.995 * 1999)]
    depth = max(0.06 * float(along.max() - along.min()), 1.5 * 0.05)
    held = region.contains(points)
    assert bool(held.any())
    sure = (along - (solid - depth)).abs() > 1e-3  # coordinates are rounded to a hundredth of a cell
    assert torch.equal(held[sure], (along >= solid - depth)[sure])


# ---- numbers


def test_statistics_of_known_gaussians():
    scales = torch.tensor([0.04, 0.4, 0.1]).log().expand(100, 3)
    opacities = torch.logit(torch.linspace(0.005, 0.995, 100))
    means = torch.rand(100, 3) * torch.tensor([2.0, 8.0, 1.0])
    own = gaussian_statistics(GaussianCloud(means, torch.ones(100, 4), scales, opacities, torch.zeros(100, 4, 3)))
    assert (own["count"], own["sh_degree"], own["normals"]) == (100, 1, False)
    assert own["S1_over_S2"] == pytest.approx([4.0] * 3)
    assert own["S2_over_S3"] == pytest.approx([2.5] * 3)
    assert own["opacity_below"]["0.1"] == pytest.approx(0.10)
    assert own["opacity"][1] == pytest.approx(0.5, abs=0.01)
    side = float(means[:, 1].max() - means[:, 1].min())
    assert own["size_share"][1] == pytest.approx(0.4 / side, rel=0.05)


def test_robust_bounds_ignore_a_far_speck():
    points = torch.rand(1000, 3)
    points[0] = 1e6
    corner = bounds(points)
    assert corner["max"] == [1e6] * 3
    assert max(corner["robust_max"]) <= 1
    assert corner["min"] == points.amin(0).tolist()


def test_spacing_of_a_lattice():
    grid = torch.cartesian_prod(*(torch.arange(8.0) * 0.3,) * 3)
    assert particle_spacing(grid) == pytest.approx(0.3)
    assert suggest_spacing(1.0, 0.001, 24) == 0.042
    assert suggest_spacing(1.0, 0.1, 24) == 0.2
    with pytest.raises(ValueError, match="longest_side"):
        suggest_spacing(0.0, 0.1, 24)


def test_sheet_and_broad_side():
    plate = torch.rand(500, 3) * torch.tensor([1.0, 0.02, 2.0])
    assert sheet_normal(plate) == (0, 1, 0)
    assert sheet_normal(torch.rand(500, 3)) is None
    assert abs(broad_side(plate)) == pytest.approx(90, abs=2)  # seen along y
    angle = math.radians(30)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    assert broad_side(plate @ turn.T) == pytest.approx(-60, abs=2)


def test_only_cloth_and_what_falls_has_weight():
    """All else was captured in balance with its weight."""

    def gravity(found):
        return yaml.safe_load(starter_yaml(found, "it.ply"))["solver"]["gravity"][2]

    flag = suggest(FlagScene(spacing=0.05).generate())
    assert (flag.youngs_modulus, gravity(flag)) == (CLOTH_E, -9.8)
    for hold, weight in (("bottom", 0.0), ("top", 0.0), ("none", -9.8)):
        found = suggest(tree(), hold=hold)
        assert found.youngs_modulus == SHELL_E
        assert gravity(found) == weight
        assert math.hypot(*found.flow) == pytest.approx(LOOKS["breeze"].speed, abs=0.01)


def test_the_material_is_that_of_its_kind():
    """By shape and colour; its density, thickness and damping are in the starter, and so is its own stiffness."""
    leaves = LeavesScene().generate()
    grey = tree()
    green = dataclasses.replace(grey, sh=grey.sh + 0.5 * torch.tensor([-1.0, 1.0, -1.0]))
    flag = FlagScene(spacing=0.05).generate()
    for cloud, name in ((flag, "fabric"), (leaves, "leaf"), (green, "leaf"), (grey, "wood")):
        found = suggest(cloud)
        assert found.material == KINDS[found.kind].material == name
        text = starter_yaml(found, "it.ply")
        material = yaml.safe_load(text)["material"]
        assert float(material["E"]) == found.youngs_modulus < MATERIALS["wood"].E
        assert material["damping_ratio"] == KINDS[found.kind].damping_ratio
        area_mass = KINDS["flag"].mass if found.kind == "flag" else MATERIALS[name].density * MATERIALS[name].thickness
        assert material["density"] * material["thickness"] == pytest.approx(area_mass, rel=1e-5)
        settings = parse_text(Simulation.parser(), text.replace("it.ply", "x.ply"))
        assert (settings.material.E, settings.material.thickness) == (found.youngs_modulus, found.thickness)
        assert settings.solver.damping == 0


def test_a_given_material_has_its_own_numbers():
    """The starter says no more than its name."""
    found = of_material(suggest(FlagScene(spacing=0.05).generate()), "silk")
    silk = MATERIALS["silk"]
    assert (found.youngs_modulus, found.thickness) == (silk.E, silk.thickness)
    assert not found.sways
    text = starter_yaml(found, "it.ply")
    assert yaml.safe_load(text)["material"] == "silk"
    assert "in still air" not in text
    assert yaml.safe_load(text)["solver"]["formulation"] == "total"
    settings = parse_text(Simulation.parser(), text)
    assert {name: settings.material[name] for name in silk.numbers} == silk.numbers
    assert settings.solver.damping == silk.damping
    with pytest.raises(ValueError, match="`--material` to be one of cotton, silk"):
        of_material(found, "slk")
