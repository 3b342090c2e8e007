"""Ground, background, things and their ranks in a capture of a place, and the suggestion for one of them."""

import math

import numpy as np
import pytest
import torch
from places import place
from shared import unit, value_error
from small_scenes import guess, plain_cloud, together, turned_cloud

from gaussian_swaying import suggest
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.scenes import DemoScene, FlagScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.moves import move_things, survey
from gaussian_swaying.suggestion.up import given_up

COUNT = 40_000


@pytest.fixture(scope="module")
def garden():
    cloud, plant = place(COUNT, sh_degree=0)
    return cloud, Gaussians.of(cloud), plant.numpy()


def _overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def _mask(members):
    return np.isin(np.arange(COUNT), members)


def _turned(cloud, quat):
    return turned_cloud(cloud, torch.tensor(quat) / math.hypot(*quat))


def test_the_parts_of_a_place(garden):
    """The plant comes first; ground and haze are what they are; the hedge is no thing on its own."""
    _, splat, plant = garden
    found = survey(splat)
    assert (found.up.direction, found.up.confidence) == ((0.0, -1.0, 0.0), "high")
    assert _overlap(_mask(found.things[0].members), plant) > 0.97
    assert len(found.things) == 2
    assert found.things[0].score > found.things[1].score + 0.5
    assert "on its own" not in found.things[1].reasons
    height, away = -splat.means[:, 1] / 0.4, np.linalg.norm(splat.means, axis=1) / 0.4
    level = (np.abs(height) < 0.0125) & (np.abs(splat.means[:, [0, 2]]) < 0.4 * 3.9).all(1) & ~plant
    assert found.ground[level].mean() > 0.99
    assert not found.ground[height > 0.05].any()
    assert not found.far[away <= 11].any()
    assert found.far[away > 15].all()


def test_a_place_that_is_tilted(garden):
    """The ground's normal is up, and the region leaves the ground out although its box does not."""
    cloud, _, plant = garden
    turn = (1.0, 0.08, 0.0, -0.06)
    cloud = _turned(cloud, turn)
    splat = Gaussians.of(cloud)
    found = survey(splat)
    up = quat_to_rotation(torch.tensor(turn) / math.hypot(*turn)) @ torch.tensor([0.0, -1.0, 0.0])
    assert float(torch.tensor(found.up.direction) @ up) > math.cos(math.radians(0.5))
    around, moving = move_things(found, splat, [1])
    inside = moving.region.contains(cloud.means).numpy() & (splat.opacity >= moving.opacity_threshold)
    assert _overlap(inside, plant) > 0.95
    assert (inside & ~plant).sum() < 5
    assert not moving.simulated[found.ground[around]].any()
    assert around.mean() < 0.3


@pytest.mark.parametrize("turn", [(1.0, 0.2, 0.0, 0.1), (1.0, 0.3, 0.0, 0.0), (1.0, 0.0, 0.0, -0.35)])
def test_the_scores_do_not_depend_on_the_tilt(garden, turn):
    """Boxes along the axes of the file would make the hedge look thin."""
    cloud, splat, plant = garden
    upright, tilted = survey(splat), survey(Gaussians.of(_turned(cloud, turn)))
    assert _overlap(_mask(tilted.things[0].members), plant) > 0.95
    for before, after in zip(upright.things, tilted.things, strict=True):
        assert after.score == pytest.approx(before.score, abs=0.3)


def test_what_the_photos_show_is_likelier(garden):
    """One photo of the plant alone and one of all: the plant gets two points, and the hedge half of them."""
    _, splat, _ = garden
    own = survey(splat).things[0]
    middle = 0.5 * (torch.tensor(own.low) + torch.tensor(own.high))
    eyes = [middle - torch.tensor([0.0, distance, 0.0]) for distance in (1.0, 12.0)]
    cameras = [look_at_camera(eye, middle, [0.0, 0.0, 1.0], 50.0, 64, 64) for eye in eyes]
    plant, hedge = survey(splat, cameras=cameras).things
    assert np.array_equal(plant.members, own.members)
    assert (plant.reasons["in the photos"], hedge.reasons["in the photos"]) == (2, 1)
    assert plant.score == pytest.approx(own.score + 2, abs=0.011)


@pytest.mark.parametrize("up", ["-y", [0.0, -1.0, 0.0], "+y"])
def test_a_given_direction_is_the_only_one_that_is_tried(garden, up):
    """From below, the haze ends nowhere on a plane: there is no ground, and the splat is taken as one object."""
    found = survey(garden[1], given_up(up))
    if up == "+y":
        assert found is None
    else:
        assert (found.up.direction, found.up.confidence) == ((0.0, -1.0, 0.0), "given")
        assert len(found.things) == 2


@pytest.mark.parametrize("scene", [DemoScene("alocasia", 0.02), FlagScene(spacing=0.03)], ids=["plant", "flag"])
def test_an_object_is_no_place(scene):
    assert survey(Gaussians.of(scene.generate())) is None


@pytest.mark.parametrize(
    ("count", "size", "away", "ground"),
    [
        (30, 8.0, 60.0, False),
        (300, 8.0, 60.0, False),
        (1200, 2.0, 20.0, False),
        (300, 0.05, 60.0, False),
        (300, 8.0, 60.0, True),
        (0, 1.0, 1.0, True),
    ],
)
def test_a_sky_is_no_object(count, size, away, ground):
    """A shrub inside a dome, with specks around it, in the air or on a ground with a few Gaussians to a column."""
    torch.manual_seed(0)
    stem = torch.rand(500, 3) * torch.tensor([0.04, 0.04, 0.6])
    crown = 0.3 * unit(1500, 3, dtype=torch.float32) * torch.rand(1500, 1) ** (1 / 3) + torch.tensor([0.0, 0.0, 0.75])
    shrub = plain_cloud(torch.cat([stem, crown]), torch.tensor([0.02, 0.02, 0.002]).log())
    specks = plain_cloud(4 * torch.rand(100, 3) - 2, math.log(0.05), logit=-1.0)
    level = torch.cat([6 * torch.rand(6000, 2) - 3, 0.005 * torch.randn(6000, 1)], 1)
    level = plain_cloud(level, torch.tensor([0.06, 0.06, 0.004]).log(), logit=4.0)
    dome = plain_cloud(away * unit(count, 3, dtype=torch.float32), math.log(size), logit=5.0)
    found = guess(together(shrub, level if ground else specks, dome), up="+z")
    if ground:
        assert len(found.place.things) == 1
        assert found.place.ground.sum() == pytest.approx(6000, rel=0.01)
    else:
        assert found.place is None
    near = np.arange(2000 + (6000 if ground else 100) + count)
    near = near if found.near is None else near[found.near]
    assert _overlap(found.moving.simulated, near < 2000) > 0.97
    assert found.moving.confidence == "high"


def test_few_gaussians_are_a_weak_guess():
    """Clusters of a dozen: none of them is known to be the object."""
    torch.manual_seed(0)
    places = (100 * torch.rand(200, 3)).repeat_interleave(12, 0) + 0.1 * torch.randn(2400, 3)
    assert guess(plain_cloud(places, math.log(0.05)), up="+z", hold="bottom").moving.confidence == "low"


def test_several_things_move_as_one_object(garden):
    cloud, splat, plant = garden
    found = guess(cloud, move=(1, 2), longest_side=1.0)
    inside, away = found.moving.region.contains(cloud.means).numpy(), np.linalg.norm(splat.means, axis=1)
    assert inside[plant].mean() > 0.97
    assert inside[(splat.means[:, 1] < -0.05) & (away > 1.5) & (away < 3)].mean() > 0.97
    assert found.size[0] == pytest.approx(1.0, abs=0.01)


def test_the_suggestion_for_a_place(garden, tmp_path):
    """Its configuration simulates the same Gaussians of the whole file, though only some were looked at."""
    cloud, _, plant = garden
    found = suggest(cloud, quality="draft", device="cpu")
    assert found.moves == (1,)
    assert len(found.simulation.scene.model.means) < COUNT
    picture = found.things().astype(int)
    assert picture.shape == (300, 600, 3)
    green = (picture[..., 1] > picture[..., 0] + 15) & (picture[..., 1] > picture[..., 2] + 15)
    assert green[:, :300].sum() > 500
    assert green[:, 300:].sum() > 500
    found.to_yaml(tmp_path / "garden.yaml")
    for simulation in (found.to_simulation("cpu"), Simulation.from_yaml(tmp_path / "garden.yaml", device="cpu")):
        simulated, parts = _mask(simulation.scene.simulated), simulation.scene.parts
        assert not (simulated & parts.mask(role="still").numpy()).any()
        assert _overlap(simulated | parts.mask("pot").numpy(), plant) > 0.97
        assert len(simulation.scene.model.means) == COUNT


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"move": [5]}, "`--move` to name things from 1 to 2"),
        ({"move": [1], "up": "+y"}, "this splat is one object"),
        ({"move": [1], "region": ([-1.0] * 3, [1.0] * 3)}, "`--move` and `--region` both choose what moves"),
    ],
)
def test_bad_choices_are_refused(garden, options, words):
    with value_error(words):
        guess(garden[0], **options)
