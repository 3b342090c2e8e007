"""What moves in a capture of a place: ground, background, things and their ranks, and the preview of one of them."""

import json
import math

import pytest
import torch
import yaml
from places import place
from shared import refused, unit
from small_scenes import plain_cloud, previewed, together, turned_cloud

from gaussian_swaying.cli.preview import build_options, main
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.preview.place import excerpt, survey
from gaussian_swaying.preview.report import doubts
from gaussian_swaying.preview.suggest import suggest
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.scenes.alocasia import AlocasiaScene
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Simulation

COUNT = 40_000


@pytest.fixture(scope="module")
def garden():
    """A place with y down, and which Gaussians are its plant."""
    return place(COUNT, sh_degree=0)


def _overlap(a, b):
    return int((a & b).sum()) / int((a | b).sum())


def _mask(members, count=COUNT):
    return torch.zeros(count, dtype=torch.bool).index_fill(0, members, True)


def _turned(cloud, quat):
    """Turned about the origin by a quaternion of any length."""
    return turned_cloud(cloud, torch.tensor(quat) / math.hypot(*quat))


def test_the_parts_of_a_place(garden):
    """The plant comes first; ground and haze are what they are; the hedge is no thing on its own."""
    cloud, plant = garden
    found = survey(cloud)
    assert found.up.direction == (0.0, -1.0, 0.0)
    assert found.up.confidence == "high"
    assert _overlap(_mask(found.things[0].members), plant) > 0.97
    assert len(found.things) == 2
    assert found.things[0].score > found.things[1].score + 0.5
    assert "on its own" not in found.things[1].reasons
    height, away = -cloud.means[:, 1] / 0.4, cloud.means.norm(dim=-1) / 0.4
    level = (height.abs() < 0.0125) & (cloud.means[:, [0, 2]].abs() < 0.4 * 3.9).all(-1) & ~plant
    assert float(found.up.ground[level].double().mean()) > 0.99
    assert float(found.up.ground[height > 0.05].double().mean()) == 0
    assert torch.equal(found.far & (away > 11), found.far)
    assert float(found.far[away > 15].double().mean()) == 1


def test_a_place_that_is_tilted(garden):
    """The ground's normal is up, and the region leaves the ground out although its box does not."""
    cloud, plant = garden
    turn = (1.0, 0.08, 0.0, -0.06)
    cloud = _turned(cloud, turn)
    found = survey(cloud)
    up = quat_to_rotation(torch.tensor(turn) / math.hypot(*turn)) @ torch.tensor([0.0, -1.0, 0.0])
    assert float(torch.tensor(found.up.direction) @ up) > math.cos(math.radians(0.5))
    shown, upward, region = excerpt(found, cloud, [1])
    inside = region.region().contains(cloud.means) & (cloud.opacities.sigmoid() >= region.opacity_threshold)
    assert _overlap(inside, plant) > 0.95
    assert int((inside & ~plant).sum()) < 5
    assert not bool(region.simulated[upward.ground].any())
    assert len(shown) < 0.3 * len(cloud)


@pytest.mark.parametrize("turn", [(1.0, 0.2, 0.0, 0.1), (1.0, 0.3, 0.0, 0.0), (1.0, 0.0, 0.0, -0.35)])
def test_the_scores_do_not_depend_on_the_tilt(garden, turn):
    """Boxes along the axes of the file would make the hedge look thin."""
    cloud, plant = garden
    upright, tilted = survey(cloud), survey(_turned(cloud, turn))
    assert tilted is not None
    assert _overlap(_mask(tilted.things[0].members), plant) > 0.95
    for before, after in zip(upright.things, tilted.things, strict=True):
        assert after.score == pytest.approx(before.score, abs=0.3)


def test_what_the_photos_show_is_likelier(garden):
    """One photo of the plant alone and one of all: the plant gets two points, and the hedge half of them."""
    cloud, _ = garden
    own = survey(cloud).things[0]
    middle = 0.5 * (torch.tensor(own.low) + torch.tensor(own.high))
    distances = {"close": 1.0, "far": 12.0}
    eyes = {name: middle - torch.tensor([0.0, distance, 0.0]) for name, distance in distances.items()}
    cameras = [look_at_camera(eye, middle, [0.0, 0.0, 1.0], 50.0, 64, 64) for eye in eyes.values()]
    plant, hedge = survey(cloud, cameras=cameras).things
    assert plant.members.equal(own.members)
    assert plant.reasons["in the photos"] == 2
    assert hedge.reasons["in the photos"] == 1
    assert plant.score == pytest.approx(own.score + 2, abs=0.011)


@pytest.mark.parametrize("up", ["-y", [0.0, -1.0, 0.0], "+y"])
def test_a_given_direction_is_the_only_one_that_is_tried(garden, up):
    """From below, the haze ends nowhere on a plane: there is no ground, and the splat is taken as one object."""
    found = survey(garden[0], up)
    if up == "+y":
        assert found is None
    else:
        assert found.up.direction == (0.0, -1.0, 0.0)
        assert found.up.confidence == "given"
        assert len(found.things) == 2


@pytest.mark.parametrize("scene", [AlocasiaScene(spacing=0.02), FlagScene(spacing=0.03)], ids=["plant", "flag"])
def test_an_object_is_no_place(scene):
    """Even on a floor of its own: there is a single thing, and nothing far away."""
    assert survey(scene.generate()) is None


def _shrub():
    """A crown on a stem, 1 high, of 2,000 fine Gaussians."""
    stem = torch.rand(500, 3) * torch.tensor([0.04, 0.04, 0.6])
    crown = 0.3 * unit(1500, 3, dtype=torch.float32) * torch.rand(1500, 1) ** (1 / 3) + torch.tensor([0.0, 0.0, 0.75])
    return plain_cloud(torch.cat([stem, crown]), torch.tensor([0.02, 0.02, 0.002]).log())


def _dome(count, size, away=60.0):
    return plain_cloud(away * unit(count, 3, dtype=torch.float32), math.log(size), logit=5.0)


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
def test_a_sky_is_no_object(tmp_path, count, size, away, ground):
    """A shrub inside a dome, with specks around it, in the air or on a ground with a few Gaussians to a column."""
    torch.manual_seed(0)
    specks = plain_cloud(4 * torch.rand(100, 3) - 2, math.log(0.05), logit=-1.0)
    level = torch.cat([6 * torch.rand(6000, 2) - 3, 0.005 * torch.randn(6000, 1)], 1)
    level = plain_cloud(level, torch.tensor([0.06, 0.06, 0.004]).log(), logit=4.0)
    cloud = together(_shrub(), level if ground else specks, _dome(count, size, away))
    preview, simulation = previewed(cloud, tmp_path)
    place = preview.data.get("place")
    if ground:
        assert len(place["things"]) == 1
        assert place["ground"] == pytest.approx(6000, rel=0.01)
    else:
        assert place is None
    chosen = _mask(simulation.scene.simulated, len(cloud))
    assert _overlap(chosen, torch.arange(len(cloud)) < 2000) > 0.97
    assert "these" not in preview.report


def test_few_gaussians_are_a_weak_guess():
    """Clusters of a dozen: none of them is known to be the object."""
    torch.manual_seed(0)
    places = (100 * torch.rand(200, 3)).repeat_interleave(12, 0) + 0.1 * torch.randn(2400, 3)
    found = suggest(plain_cloud(places, math.log(0.05)), up="+z", hold="bottom")
    assert found.region.confidence == "low"
    count, defaults = int(found.region.simulated.sum()), build_options().parse_args([])
    first, second = doubts(found, build_options().parse_args(["a b.ply"]), defaults)
    assert f"warning: that these {count} Gaussians are the object is a weak guess" in first
    assert "'a b.ply' --region" in second


def test_several_things_move_as_one_object(garden):
    cloud, plant = garden
    shown, upward, region = excerpt(survey(cloud), cloud, [1, 2])
    inside = region.region().contains(cloud.means)
    assert float(inside[plant].double().mean()) > 0.97
    hedge = (cloud.means[:, 1] < -0.05) & (cloud.means.norm(dim=-1) > 1.5) & (cloud.means.norm(dim=-1) < 3)
    assert float(inside[hedge].double().mean()) > 0.97
    assert suggest(shown, found=(upward, region), longest_side=1.0).size[0] == pytest.approx(1.0, abs=0.01)


@pytest.fixture
def file(garden, tmp_path):
    path = tmp_path / "garden.ply"
    write_ply(path, garden[0])
    return path


def _preview(file, out, *options):
    return main(
        [str(file), "--output", str(out), "--device", "cpu", "--height", "96", "--frames", "2", "--verbose", *options]
    )


def test_the_preview_of_a_place(file, garden, tmp_path, capsys, monkeypatch):
    """It lists what may move, draws it, and its starter simulates the same Gaussians of the whole file."""
    monkeypatch.setattr("gaussian_swaying.preview.cost.MOST_FRAMES", 2)
    out = tmp_path / "out"
    assert _preview(file, out) == 0
    told = capsys.readouterr().out
    assert "1 moves" in told
    assert "background" in told
    data = json.loads((out / "preview.json").read_text())
    assert data["place"]["moves"] == [1]
    assert len(data["place"]["things"]) == 2
    assert data["gaussians"]["count"] == COUNT
    import imageio.v3 as iio

    picture = iio.imread(out / "things.png").astype(int)
    assert picture.shape == (300, 600, 3)
    green = (picture[..., 1] > picture[..., 0] + 15) & (picture[..., 1] > picture[..., 2] + 15)
    assert green[:, :300].sum() > 500
    assert green[:, 300:].sum() > 500
    simulation = Simulation.from_yaml(out / "starter.yaml", device="cpu")
    parts = simulation.scene.parts  # of the whole file, though only what is around the plant was looked at
    assert not bool((_mask(simulation.scene.simulated) & parts.mask(role="still")).any())
    chosen = _mask(simulation.scene.simulated) | parts.mask("pot")
    assert _overlap(chosen, garden[1]) > 0.97
    assert len(simulation.scene.model.means) == COUNT
    region = yaml.safe_load((out / "starter.yaml").read_text())["scene"]["region"]
    assert region["class_path"]


def test_a_thing_is_chosen_by_its_number(file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.preview.cost.MOST_FRAMES", 2)
    monkeypatch.setattr("gaussian_swaying.cli.preview.LARGE", 0)
    assert _preview(file, tmp_path / "out", "--move", "2, 2") == 0
    told = capsys.readouterr().out
    assert "only constant colours were read" in told  # and not that the file has degree 0
    assert "SH degree" not in told
    assert "2 moves" in told
    assert "thing 2 of the place" in told
    data = json.loads((tmp_path / "out" / "preview.json").read_text())
    assert data["gaussians"]["sh_degree"] is None
    box = data["run"]
    assert box["box_max"][0] - box["box_min"][0] == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--move", "5"], "`--move` to name things from 1 to 2"),
        (["--move", "a"], "`--move` to be numbers of things"),
        (["--move", "1", "--up", "+y"], "this splat is one object"),
        (["--move", "1", "--region", *["-1"] * 3, *["1"] * 3], "`--move` and `--region` both choose what moves"),
        (["--move", "1", "--config", "any.yaml"], "`--move` is for suggestions"),
    ],
)
def test_bad_choices_are_refused(file, tmp_path, capsys, options, words):
    folder = tmp_path / "here"
    folder.mkdir()
    refused(lambda given: _preview(file, folder / "out", *given), options, capsys, words, folder=folder)
