import math

import pytest
import torch
from shared import alike, double, peak, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.scenes import DemoScene, FlagScene
from gaussian_swaying.scenes.alocasia import alocasia
from gaussian_swaying.scenes.ficus import ficus
from gaussian_swaying.scenes.leaves import leafy_branch
from gaussian_swaying.scenes.patches import baked
from gaussian_swaying.scenes.sand import bear_height, sand_bear
from gaussian_swaying.scenes.stage import SKY, cast, floor
from gaussian_swaying.scenes.telephone import cord, handset
from gaussian_swaying.scenes.vase import vase
from gaussian_swaying.scenes.windbreaks import ficus_behind_wall, plant_row

SCENES = ["alocasia", "ficus", "leaves", "sand", "telephone", "vase"]
FIELDS = ("means", "quats", "scales", "opacities", "sh", "normals")


@pytest.mark.parametrize("kind", SCENES)
def test_a_scene_is_a_usable_splat(kind):
    cloud = DemoScene(kind).generate()
    assert 20_000 <= len(cloud) <= 200_000
    assert all(torch.isfinite(getattr(cloud, name)).all() for name in FIELDS)
    assert_close(cloud.normals.norm(dim=-1), torch.ones(len(cloud)), atol=1e-5, rtol=0)
    model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
    assert (model.normals() * cloud.normals).sum(-1).min() > 0.999
    assert cloud.opacities.sigmoid().min() > 0.9
    colours = model.colors(torch.tensor([0.0, 1.0, 0.0]))
    assert colours.min() >= -1e-6
    assert colours.max() <= 1 + 1e-6
    assert colours.std(0).min() > 0.02
    coarse = DemoScene(kind, 0.2).generate().means
    assert 1.3 * len(coarse) < len(cloud)
    for side in (torch.amin, torch.amax):
        assert peak(side(coarse, 0) - side(cloud.means, 0)) < 0.25


@pytest.mark.parametrize("kind", SCENES)
def test_the_same_arguments_give_the_same_splat(kind):
    one, two = (DemoScene(kind, 0.05).generate() for _ in range(2))
    for name in FIELDS:
        assert torch.equal(getattr(one, name), getattr(two, name)), name


def test_the_leaves_cover_the_area_of_their_outlines(leaf_area):
    """Sizes are drawn from 0.75 to 1.15 and blades are bent by some percent, so within a tenth of the mean."""
    many, few = (leafy_branch(count=n, spacing=0.02) for n in (300, 100))
    areas = [
        float(GaussianSurfaceModel.from_cloud(cloud, requires_grad=False).areas("paper").sum()) for cloud in (many, few)
    ]
    # pi s1 s2 of a Gaussian with standard deviations of 0.45 times the edges
    mean_square = (1.15**3 - 0.75**3) / (3 * 0.4)
    expected = 200 * leaf_area(0.17, 0.075, (0.6, 0.9)) * mean_square * math.pi * 0.45**2
    assert areas[0] - areas[1] == pytest.approx(expected, rel=0.1)


def test_the_sand_is_as_steep_as_allowed_and_filled():
    """No slope above 28 degrees, and one Gaussian inside per cube of the spacing."""
    cloud = sand_bear(0.02)
    skin = (cloud.means[:, 2] > 0) & (cloud.scales.amax(-1).exp() > 0.005)
    slope = cloud.normals[skin, 2].acos().rad2deg()
    assert slope.max() <= 28.01
    assert slope.max() > 24
    x = torch.arange(-1.2, 1.2, 0.01, dtype=torch.float64)
    y = torch.arange(-1.2, 1.5, 0.01, dtype=torch.float64)
    height = bear_height(*torch.meshgrid(x, y, indexing="ij"))
    hollow = sand_bear(spacing=0.02, interior=False)
    inside = len(cloud) - len(hollow)
    # the skin stands for the last layer: what is left below it is the height less 0.9 spacings, on average
    below = (height - 0.9 * 0.02).clamp_min(0).sum() * 1e-4
    assert inside * 0.02**3 == pytest.approx(float(below), rel=0.05)


def test_the_wind_reaches_three_layers_of_sand_that_share_its_surface():
    """So that there are grains to take where some were taken; what lies deeper owns almost none of the area."""
    cloud = sand_bear(0.02)
    bear = cloud.select(cloud.means[:, 2] > 0)
    speck = bear.scales.amax(-1).exp() < 0.003
    areas = GaussianSurfaceModel.from_cloud(bear, requires_grad=False).areas("paper").double()
    assert areas[speck].sum() < 0.01 * areas.sum()
    skin = sand_bear(spacing=0.02, interior=False)
    skin = skin.select(skin.means[:, 2] > 0)
    # each of the skin stands for a third of a square of the spacing seen from above; pi 0.55^2 = 0.95 of its area
    own = GaussianSurfaceModel.from_cloud(skin, requires_grad=False).areas("paper").double()
    surface = 0.02**2 / skin.normals[:, 2].double() * math.pi * 0.55**2
    alike(own, surface / 3, 1e-4)
    # the layers below are level, and missing where the bear is thin
    assert 0.65 < areas.sum() / surface.sum() < 1.0
    depth = bear_height(*bear.means[~speck, :2].double().T) - bear.means[~speck, 2].double()
    assert depth.max() < 3.6 * 0.02  # a grain's place in its layer is half a spacing off


def test_the_handset_hangs_on_a_coil():
    coil = cord(0.004, 16)
    assert coil.center[0, 2] > -0.02
    low = float(coil.center[:, 2].min())
    assert -0.40 < low < -0.34
    # wound 16 times with a radius of 22 mm, but for its ends, the wire is far longer than it hangs low
    length = float(coil.area.sum()) / (2 * math.pi * 0.006)
    assert length > 0.75 * 16 * 2 * math.pi * 0.022
    hung = torch.cat([part.center for part in handset(0.008)])
    assert hung[:, 2].max() > low  # the cord ends in its upper cup
    assert -0.85 < hung[:, 2].min() < -0.75
    assert hung[:, 1].max() < 0.09  # before the wall


@pytest.mark.parametrize("stand", ["pole", "posts", "rod"])
def test_a_stand_lies_outside_the_box_of_its_flag(stand):
    """So a region can pick the flag; each corner or edge that is held has something next to it that holds it."""
    sizes = {"width": 1.0, "height": 0.6, "spacing": 0.02}
    cloud = FlagScene(**sizes, stand=stand).generate()
    flag = FlagScene(**sizes).generate()
    assert torch.equal(cloud.means[: len(flag)], flag.means)
    rest = cloud.means[len(flag) :]
    box = (rest >= torch.tensor([0.0, -0.005, 0.0])) & (rest <= torch.tensor([1.0, 0.005, 0.6]))
    assert not box.all(-1).any()
    held = {
        "pole": [(0.0, 0.0), (0.0, 0.3), (0.0, 0.6)],
        "posts": [(0.0, 0.6), (1.0, 0.6), (1.0, 0.0)],
        "rod": [(0.0, 0.6), (0.5, 0.6), (1.0, 0.6)],
    }[stand]
    for x, z in held:
        assert (rest - torch.tensor([x, 0.0, z])).norm(dim=-1).min() < 0.04
    free = torch.tensor([1.0, 0.0, 0.3] if stand == "pole" else [0.0, 0.0, 0.0])
    assert (rest - free).norm(dim=-1).min() > 0.05
    turned = FlagScene(**sizes, stand=stand, yaw=90.0).generate().means
    assert_close(turned[:, 1], cloud.means[:, 0], atol=1e-5, rtol=0)


def test_a_floor_runs_into_the_sky_and_bears_a_shadow():
    """In the colours as they are drawn, light included, so no rim of the floor is seen."""
    ground = floor(0.05, (0.5, 0.4, 0.3), [(0.5, 0.0, 0.1, 0.6)], fade=(1.0, 3.0))
    r = ground.center.norm(dim=-1)
    shown = baked(ground, 0.45, two_sided=True)
    assert peak(shown[r > 3.0] - double(SKY)) < 1e-9
    assert r.max() > 12
    spot = (ground.center - torch.tensor([0.5, 0.0, 0.0]).double()).norm(dim=-1)
    dark, light = shown[spot < 0.04].mean(), shown[(spot > 0.3) & (r < 0.9)].mean()
    assert float(dark / light) == pytest.approx(0.4, abs=0.08)
    assert ground.normal[:, 2].min() > 0.999
    # a light from the left, in front and above throws the shadow to the right and back
    x, y, _, _ = cast((0.0, 0.0, 1.0), 0.3, 0.5)
    assert x == pytest.approx(0.4 / 0.6)
    assert y == pytest.approx(0.7 / 0.6)


def test_ups_are_up():
    """Pots stand on z = 0 and the plants grow above them; the table lies at z = 0 and the beach a little lower."""
    for plant in (ficus, alocasia):
        z = plant(spacing=0.05).means[:, 2]
        assert z.min() > -1e-6
        assert z.max() > 0.9
    assert vase(spacing=0.02).means[:, 2].max() > 0.55
    assert float(sand_bear(spacing=0.05).means[:, 2].min()) == pytest.approx(-0.08, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        *((kind, "spacing", value) for kind in SCENES for value in (0.0, -1.0, math.nan, 0.3)),
        ("ficus", "count", 0),
        ("leaves", "count", 2),
        ("alocasia", "count", -1),
        ("alocasia", "size", -1.0),
        ("vase", "count", 0),
        ("telephone", "count", 0),
        ("telephone", "size", 1.0),
        ("sand", "size", 1.0),
        ("bear", "kind", "bear"),
    ],
)
def test_bad_arguments_are_refused(kind, name, value):
    with value_error(rf"generator\.{name}"):
        DemoScene(**{"kind": kind, name: value})


def test_a_stand_of_another_kind_is_refused():
    with value_error(r"generator\.stand"):
        FlagScene(stand="hand")


def test_plants_stand_in_a_row():
    cloud = plant_row(0.05, 20, plants=3)
    plants = cloud.means[cloud.means[:, 2] > 0.3]
    assert {round(float(x) / 0.6) for x in plants[:, 0]} == {-1, 0, 1}
    assert peak(plants[:, 1]) < 0.35
    assert 1.0 < plants[:, 2].max() < 1.4
    assert plants[:, 0].mean().abs() < 0.03


def test_a_wall_stands_before_the_ficus():
    cloud, tree = ficus_behind_wall(spacing=0.1, count=50), ficus(spacing=0.1, count=50)
    assert torch.equal(cloud.means[: len(tree)], tree.means)
    wall = cloud.means[len(tree) :]
    assert_close(wall.amin(0), torch.tensor([-1.6, -1.2, 0.0]), rtol=0, atol=0.06)
    assert_close(wall.amax(0), torch.tensor([-1.4, 1.2, 1.3]), rtol=0, atol=0.06)


def test_a_clear_floor_is_fine_and_has_no_shadows():
    found = []
    for radius in (0.0, 2.0):
        cloud = alocasia(spacing=0.02, size=radius)
        flat, away = cloud.means[:, 2].abs() < 1e-6, cloud.means[:, :2].norm(dim=-1)
        near, far = flat & (away > 0.2) & (away < 0.6), flat & (away > 1.5) & (away < 2.0)
        found.append((float(cloud.sh[near, 0].std(0).max()), float(cloud.scales[far].amax(-1).exp().mean())))
    (shaded, wide), (plain, small) = found
    assert plain < 0.05 < 0.15 < shaded
    assert small < 0.04 < 0.08 < wide
