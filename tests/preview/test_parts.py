"""Pot, soil, stems and leaves of a plant, by shape and colour."""

import dataclasses
import math
from dataclasses import replace

import pytest
import torch
import yaml
from small_scenes import coloured, started

from gaussian_swaying.cli.preview import main
from gaussian_swaying.gaussians.cloud import joined
from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.preview.parts import plant_parts
from gaussian_swaying.preview.suggest import suggest, visible_weight
from gaussian_swaying.scenes.alocasia import AlocasiaScene
from gaussian_swaying.scenes.ficus import FicusScene
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.scenes.solid import SolidScene
from gaussian_swaying.scenes.telephone import TelephoneScene
from gaussian_swaying.scenes.vase import VaseScene


@pytest.fixture(scope="module")
def alocasia():
    return AlocasiaScene(spacing=0.005).generate()


def found(cloud, up=(0.0, 0.0, 1.0)):
    return plant_parts(cloud, torch.ones(len(cloud), dtype=torch.bool), up, visible_weight(cloud))


def share(of, among):
    return float(of[among].double().mean())


def check_alocasia(parts, means):
    """Against the numbers of the scene, z up: a pot 0.22 m high, soil at 0.2024 m, blades at the ends of stalks."""
    across, height = means[:, :2].norm(dim=-1), means[:, 2]
    wall = (across > 0.12) & (across < 0.19) & (height > 0.01) & (height < 0.195)
    soil = (across < 0.14) & ((height - 0.2024).abs() < 1e-3)
    blades = height > 0.75
    stalks = (across < 0.09) & (height > 0.25) & (height < 0.35)
    floor = across > 0.4
    assert share(parts.mask("pot"), wall) > 0.99
    assert share(parts.mask("soil"), soil) > 0.98
    assert share(parts.mask("leaf"), blades & (across > 0.15)) > 0.95
    assert share(parts.mask("stem"), stalks) > 0.9
    assert share(parts.mask("surroundings"), floor & (height < 0.02)) > 0.99
    assert share(parts.mask(role="soft"), height > 0.26) == 1.0
    assert [part.role for part in parts.parts] == ["still", "held", "soft", "soft", "still"]


def test_the_parts_of_a_plant(alocasia):
    plant = found(alocasia)
    check_alocasia(plant.parts, alocasia.means)
    assert "with soil at 0.2" in plant.reason
    assert "pot still" in plant.words()


def test_haze_goes_with_what_it_lies_on(alocasia):
    """Large and faint above a leaf it moves with it; the same, opaque or out of reach, is something else."""
    leaf = int(alocasia.means[:, 2].argmax())
    haze = alocasia.select(torch.full((3,), leaf))
    means = haze.means + torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.1], [0.0, 0.0, 0.4]])
    haze = replace(haze, means=means, scales=torch.full((3, 3), math.log(0.06)), normals=None)
    haze = replace(haze, opacities=torch.tensor([0.05, 0.9, 0.05]).logit())
    cloud = joined(replace(alocasia, normals=None), haze)
    simulated = torch.arange(len(cloud)) < len(alocasia)
    parts = plant_parts(cloud, simulated, (0.0, 0.0, 1.0), visible_weight(cloud)).parts
    assert [parts.parts[k].name for k in parts.labels[-3:]] == ["leaf", "surroundings", "surroundings"]


def test_any_axis_may_be_up(alocasia):
    x, y, z = alocasia.means.unbind(-1)
    turned = dataclasses.replace(alocasia, means=torch.stack([x, -z, y], -1) * 7 + torch.tensor([3.0, -2.0, 1.0]))
    check_alocasia(found(turned, (0.0, -1.0, 0.0)).parts, alocasia.means)


def test_a_tree_has_a_brown_stem(alocasia):
    cloud = FicusScene(spacing=0.01).generate()
    parts, (x, y, z) = found(cloud).parts, cloud.means.unbind(-1)
    across = torch.hypot(x, y)
    assert share(parts.mask("pot"), (across > 0.14) & (across < 0.22) & (z > 0.05) & (z < 0.25)) > 0.99
    assert share(parts.mask("stem"), (across < 0.1) & (z > 0.4) & (z < 0.8)) > 0.95
    assert share(parts.mask("leaf"), z > 1.5) > 0.9


def test_faint_gaussians_are_labelled_as_their_neighbours(alocasia):
    opaque = torch.ones(len(alocasia), dtype=torch.bool)
    opaque[::3] = False
    plant = plant_parts(alocasia, opaque, (0.0, 0.0, 1.0), visible_weight(alocasia))
    check_alocasia(plant.parts, alocasia.means)


def test_a_pot_without_soil_is_held(alocasia):
    """Otherwise nothing would hold the stalks."""
    soil = (alocasia.means[:, :2].norm(dim=-1) < 0.156) & ((alocasia.means[:, 2] - 0.2024).abs() < 1e-3)
    parts = found(alocasia.select(~soil)).parts
    assert {part.name: part.role for part in parts.parts}["pot"] == "held"
    assert "soil" not in [part.name for part in parts.parts]


@pytest.mark.parametrize("scene", [VaseScene, TelephoneScene, SolidScene, FlagScene])
def test_other_objects_have_no_parts(scene):
    assert found(scene().generate()) is None


def test_a_pot_alone_and_a_plant_alone_have_no_parts(alocasia):
    high = alocasia.means[:, 2] > 0.24
    assert found(alocasia.select(~high)) is None
    assert found(alocasia.select(high)) is None
    assert found(coloured(alocasia, (0.7, 0.2, 0.2), high)) is None  # not a plant, by its colour


def test_the_suggestion_and_its_configuration(alocasia, tmp_path):
    """The plant moves, the pot does not, and sizes are those of the plant with its pot."""
    on_floor = alocasia.means[:, :2].norm(dim=-1) < 0.6
    cloud = alocasia.select(on_floor & ~((alocasia.means[:, 2] < 0.005) & on_floor))
    guess = suggest(cloud, up="+z", quality="draft", longest_side=1.0)
    assert guess.pin is None
    assert guess.fixed
    assert guess.up.confidence == "given"
    assert not bool((guess.region.simulated & guess.parts.still).any())
    size = cloud.means.amax(0) - cloud.means.amin(0)
    assert guess.metres_per_unit == pytest.approx(1 / float(size.amax()), rel=1e-3)
    moving = cloud.means[guess.region.simulated]
    assert guess.longest_side == pytest.approx(float((moving.amax(0) - moving.amin(0)).amax() / size.amax()), rel=1e-3)
    simulation = started(guess, cloud, tmp_path)
    assert simulation.scene.frame.metres_per_unit == pytest.approx(guess.metres_per_unit, rel=1e-4)
    assert simulation.solver.gravity == (0.0, 0.0, 0.0)
    last = list(simulation.frames(9))[-1]
    moved = (last.gaussians.means - simulation.scene.rest().means).norm(dim=-1) / float(size.amax())
    parts = simulation.scene.parts
    assert float(moved[parts.mask("pot") | parts.mask("soil")].max()) == 0.0
    assert float(moved[parts.mask("leaf")].max()) > 0.01
    given = suggest(cloud, up="+z", hold="bottom", quality="draft")
    assert given.parts is None
    assert given.pin is not None


def test_the_preview_writes_the_parts_that_its_configurations_name(alocasia, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gaussian_swaying.preview.cost.MOST_FRAMES", 2)
    cloud = alocasia.select((alocasia.means[:, :2].norm(dim=-1) < 0.6) & (alocasia.means[:, 2] > 0.005))
    write_ply(tmp_path / "plant.ply", cloud)
    out = tmp_path / "out"
    options = [
        str(tmp_path / "plant.ply"),
        "--output",
        str(out),
        "--device",
        "cpu",
        "--height",
        "96",
        "--verbose",
        "--quality",
    ]
    monkeypatch.setattr("gaussian_swaying.cli.preview.why_apart", lambda scene, dx, held: f"{int(held.sum()) > 50}")
    assert main([*options, "draft"]) == 0
    told = capsys.readouterr().out
    assert "pot still" in told
    assert "each connected part has its own (scene.connected: surface), as True; --connected grid leaves" in told
    assert str(out / "parts.npz") in told
    config = yaml.safe_load((out / "starter.yaml").read_text())
    assert config["scene"]["parts"] == str(out / "parts.npz")
    assert config["solver"]["boundaries"] == []
    assert config["scene"]["connected"] == "surface"
    parts = Parts.load(out / "parts.npz")
    assert len(parts) == len(cloud)
    painted = Parts(parts.labels.flip(0), parts.parts)
    painted.save(out / "parts.npz")
    assert main([*options, "draft"]) == 0
    assert Parts.load(out / "parts.1.npz").digest() == painted.digest()  # what was there is kept
    assert Parts.load(out / "parts.npz").digest() == parts.digest()
    assert main([*options, "draft"]) == 0
    assert not (out / "parts.2.npz").exists()
    monkeypatch.setattr("gaussian_swaying.cli.preview.why_apart", lambda scene, dx, held: None)
    assert main([*options, "draft"]) == 0
    assert "connected" not in yaml.safe_load((out / "starter.yaml").read_text())["scene"]
