"""Kinds of things and their parts: plants in pots, flags on poles, washing lines, what hangs, trees and signs."""

import dataclasses
import math
from dataclasses import replace

import pytest
import torch
from shared import value_error
from small_scenes import GREEN, coloured, guess, plain_cloud, started
from things import (
    AWAY,
    BLUE,
    GREY,
    SKIN,
    cone,
    figure,
    flag_on_a_pole,
    full,
    lamp,
    painted,
    potted_plant,
    sign,
    small_tree,
    splat,
    tube,
    tuft,
    washing_line,
)

from gaussian_swaying.gaussians.cloud import joined
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.scenes.alocasia import alocasia as alocasia_of
from gaussian_swaying.scenes.ficus import ficus
from gaussian_swaying.scenes.solid import SolidScene
from gaussian_swaying.scenes.telephone import telephone
from gaussian_swaying.scenes.vase import vase
from gaussian_swaying.suggestion import parts as finders
from gaussian_swaying.suggestion.kinds import KINDS, STEM_E


@pytest.fixture(scope="module")
def alocasia():
    return alocasia_of(spacing=0.005)


def found(cloud, *more, by=finders.potted_plant, up=(0.0, 0.0, 1.0), simulated=None):
    own, axis = Gaussians.of(cloud), torch.tensor(up).double().numpy()
    simulated = (torch.ones(len(cloud)) if simulated is None else simulated).bool().numpy()
    height = own.means[simulated] @ axis
    labels = by(own[simulated], axis, *more)
    labels = labels[0] if labels is not None and len(labels) == 2 else labels  # without where it is held
    return finders.labelled(own, simulated, height.max() - height.min(), labels)


def roles(parts):
    return [(part.name, part.role) for part in parts.parts.parts]


def share(of, among):
    return float(of[among].mean())


# ---- a plant in a pot


def check_alocasia(plant, means):
    """Against the numbers of the scene, z up: a pot 0.22 m high, soil at 0.2024 m, blades at the ends of stalks."""
    across, height = means[:, :2].norm(dim=-1), means[:, 2]
    wall = (across > 0.12) & (across < 0.19) & (height > 0.01) & (height < 0.195)
    soil = (across < 0.14) & ((height - 0.2024).abs() < 1e-3)
    stalks = (across < 0.09) & (height > 0.25) & (height < 0.35)
    assert share(plant.mask("pot"), wall) > 0.99
    assert share(plant.mask("soil"), soil) > 0.98
    assert share(plant.mask("leaf"), (height > 0.75) & (across > 0.15)) > 0.95
    assert share(plant.mask("stem"), stalks) > 0.9
    assert share(plant.mask("surroundings"), (across > 0.4) & (height < 0.02)) > 0.99
    assert share(plant.mask(role="soft"), height > 0.26) == 1.0
    assert [role for _, role in roles(plant)] == ["still", "held", "soft", "soft", "still"]


def test_the_parts_of_a_plant(alocasia):
    plant = found(alocasia)
    check_alocasia(plant, alocasia.means)
    assert "with soil at 0.2" in plant.reason
    assert "pot still" in plant.words()
    x, y, z = alocasia.means.unbind(-1)  # any axis may be up
    turned = replace(alocasia, means=torch.stack([x, -z, y], -1) * 7 + torch.tensor([3.0, -2.0, 1.0]))
    check_alocasia(found(turned, up=(0.0, -1.0, 0.0)), alocasia.means)


def test_haze_goes_with_what_it_lies_on(alocasia):
    leaf = int(alocasia.means[:, 2].argmax())
    haze = alocasia.select(torch.full((3,), leaf))
    means = haze.means + torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.1], [0.0, 0.0, 0.4]])
    haze = replace(haze, means=means, scales=torch.full((3, 3), math.log(0.06)), normals=None)
    haze = replace(haze, opacities=torch.tensor([0.05, 0.9, 0.05]).logit())
    cloud = joined(replace(alocasia, normals=None), haze)
    plant = found(cloud, simulated=torch.arange(len(cloud)) < len(alocasia))
    assert [plant.names[k] for k in plant.parts.labels[-3:]] == ["leaf", "surroundings", "surroundings"]


def test_a_tree_has_a_brown_stem():
    cloud = ficus(spacing=0.01)
    plant, (x, y, z) = found(cloud), cloud.means.unbind(-1)
    across = torch.hypot(x, y)
    assert share(plant.mask("pot"), (across > 0.14) & (across < 0.22) & (z > 0.05) & (z < 0.25)) > 0.99
    assert share(plant.mask("stem"), (across < 0.1) & (z > 0.4) & (z < 0.7)) > 0.95
    assert share(plant.mask("leaf"), z > 1.5) > 0.85


def test_a_pot_without_soil_is_held(alocasia):
    """Otherwise nothing would hold the stalks."""
    soil = (alocasia.means[:, :2].norm(dim=-1) < 0.156) & ((alocasia.means[:, 2] - 0.2024).abs() < 1e-3)
    plant = found(alocasia.select(~soil))
    assert ("pot", "held") in roles(plant)
    assert "soil" not in plant.names


@pytest.mark.parametrize("scene", [vase, telephone, SolidScene().generate, FlagScene().generate])
def test_other_objects_have_no_parts(scene):
    assert found(scene()) is None


def test_a_pot_alone_and_a_plant_alone_have_no_parts(alocasia):
    high = alocasia.means[:, 2] > 0.24
    for cloud in (alocasia.select(~high), alocasia.select(high), coloured(alocasia, (0.7, 0.2, 0.2), high)):
        assert found(cloud) is None


def test_a_plant_moves_in_its_pot(tmp_path):
    """Sizes are those of the plant with its pot, and the ground around is no part of them."""
    cloud = potted_plant(0.008)
    cloud = cloud.select(cloud.means[:, 2] > 0.005)
    found = guess(cloud, up="+z", quality="draft", longest_side=1.0)
    assert (found.pin, found.fixed, found.up.confidence) == (None, True, "given")
    still = found.parts.mask(role="still")
    assert not (found.moving.simulated & still).any()
    size = cloud.means.amax(0) - cloud.means.amin(0)
    assert found.metres_per_unit == pytest.approx(1 / float(size.amax()), rel=1e-3)
    moving = cloud.means[torch.from_numpy(found.moving.simulated)]
    assert found.longest_side == pytest.approx(float((moving.amax(0) - moving.amin(0)).amax() / size.amax()), rel=1e-3)
    simulation = started(found, cloud, tmp_path)
    assert simulation.scene.frame.metres_per_unit == pytest.approx(found.metres_per_unit, rel=1e-4)
    last = list(simulation.frames(9))[-1]
    moved = (last.gaussians.means - simulation.scene.rest().means).norm(dim=-1) / float(size.amax())
    assert float(moved[found.parts.mask("pot") | found.parts.mask("soil")].max()) == 0.0
    assert moved[found.parts.mask("leaf")].max() > 0.01
    given = guess(cloud, up="+z", hold="bottom", quality="draft")
    assert given.parts is None
    assert given.pin is not None
    place = guess(alocasia_of(spacing=0.01), up="+z")
    assert place.kind == "plant"
    assert 0.5 < place.longest_side <= 1.0


# ---- flags on poles, washing lines


@pytest.mark.parametrize("yaw", [0.0, 30.0, 200.0])
def test_a_flag_and_its_pole(yaw):
    cloud, cloth = flag_on_a_pole(yaw=yaw), len(FlagScene(spacing=0.025).generate())
    own = Gaussians.of(cloud)
    (label, parts, reason), held = finders.flag_on_pole(own, torch.tensor([0.0, 0.0, 1.0]).numpy())
    assert [(part.name, part.role) for part in parts] == [("cloth", "soft"), ("pole", "still")]
    assert (label[:cloth] == 0).mean() > 0.95
    assert (label[cloth:] == 1).all()
    away = own.means[:cloth].mean(0) - own.means[cloth:].mean(0)
    away[2] = 0.0
    assert held.direction @ away / math.hypot(*away) == pytest.approx(-1.0, abs=0.02)
    assert "alone over 0.6" in reason


def test_any_axis_may_be_up_and_the_pole_may_be_below_only():
    cloud = flag_on_a_pole()
    x, y, z = cloud.select(cloud.means[:, 2] < 0.8).means.unbind(-1)
    turned = plain_cloud(torch.stack([x, -z, y], -1) * 7 + torch.tensor([3.0, -2.0, 1.0]))
    _, held = finders.flag_on_pole(Gaussians.of(turned), torch.tensor([0.0, -1.0, 0.0]).numpy())
    assert held.direction == pytest.approx((-1.0, 0.0, 0.0))


def test_a_flag_without_its_pole_or_with_two_or_on_a_rod_has_no_pole():
    for kind in ("posts", "rod", "none"):
        cloud = FlagScene(stand=kind).generate()
        assert finders.flag_on_pole(Gaussians.of(cloud), torch.tensor([0.0, 0.0, 1.0]).numpy()) is None
        assert (guess(cloud).parts is None) == (kind != "posts")
    assert guess(FlagScene().generate()).parts is None


def test_a_flag_has_the_size_of_its_cloth_and_pole():
    cloud = flag_on_a_pole()
    found = guess(cloud, up="+z", quality="draft")
    assert (found.hold.name, found.hold.confidence, found.sheet) == ("side", "high", True)
    assert found.longest_side == pytest.approx(1.2 * found.metres_per_unit, rel=0.05)  # of the cloth
    size = float((cloud.means.amax(0) - cloud.means.amin(0)).amax())
    assert found.metres_per_unit == pytest.approx(1 / size, rel=1e-3)
    assert guess(cloud, up="+z", hold="-x").parts is None


def test_posts_of_a_washing_line_stand():
    moving, means = washing_line()
    cloud = plain_cloud(means, -4.0, logit=2.0)
    line = found(cloud, by=finders.washing_line)
    assert roles(line) == [("cloth", "soft"), ("post", "still")]
    label = line.parts.labels
    assert (label[:6000] == 0).all()
    assert (label[6000 : len(moving)] == 0).double().mean() > 0.8  # the line, but for its ends
    assert (label[len(moving) :] == 1).all()
    suggestion = guess(cloud, up="+z")
    assert (suggestion.kind, suggestion.hold.name) == ("cloth", "top")
    assert suggestion.metres_per_unit == pytest.approx(2.5 / 2.3, rel=0.05)  # with the feet


def test_a_sheet_without_two_posts_has_none():
    moving, one = washing_line((0.0,))
    curtain = moving * torch.tensor([1.0, 1.0, 2.0])  # down to the ground
    for means in (moving, one, curtain):
        assert found(plain_cloud(means, -4.0, logit=2.0), by=finders.washing_line) is None


# ---- what hangs or stands


def test_what_hangs_from_a_cord():
    cloud = splat(*lamp(), move=AWAY)
    found = guess(cloud, up="+z")
    height = (cloud.means[:, 2] - AWAY[2]).numpy()
    assert roles(found.parts) == [("hook", "held"), ("cord", "soft"), ("body", "rigid")]
    assert found.parts.mask("hook")[height > 0.88].all()
    assert found.parts.mask("cord")[(height > 0.32) & (height < 0.8)].all()
    assert found.parts.mask("body")[height < 0.22].all()
    assert (found.pin, found.fixed, found.kind) == (None, True, "hanging")
    assert found.parts.reason == "it hangs from its upper end by a cord"
    bulb, _, plate = lamp()
    thick = splat(bulb, tube([0.0, 0.0, 0.2], [0.0, 0.0, 0.9], 0.1), plate)
    assert "a neck of 0." in guess(thick, up="+z", hold="top").parts.reason


def test_a_tree_stands_on_its_foot():
    """A trunk is round and brown below green leaves, as a pot is, but slender; and a tree must be green."""
    tree = small_tree(0.01)
    guessed = guess(tree, up="+z")
    (x, y, z), parts = tree.means.unbind(-1), guessed.parts
    assert roles(parts) == [("foot", "held"), ("wood", "soft"), ("leaf", "soft")]
    assert parts.mask("foot")[z < 0.38].all()
    assert share(parts.mask("wood"), (torch.hypot(x, y) < 0.1) & (z > 0.48) & (z < 0.7)) > 0.99
    assert share(parts.mask("leaf"), z > 1.5) > 0.9
    assert (guessed.pin, guessed.hold.name) == (None, "bottom")
    for color in ((0.5, 0.4, 0.3), (0.2, 0.5, 0.2)):  # dead, and a bush
        assert found(coloured(tree, color), 0.1, by=finders.standing) is None


def test_a_sign_on_a_post():
    cloud = sign()
    guessed = guess(cloud, up="+z")
    parts, z = guessed.parts, cloud.means[:, 2].numpy()
    assert guessed.hold.name == "bottom"
    assert roles(parts) == [("foot", "held"), ("post", "soft"), ("head", "soft")]
    for name, where in (("foot", z < 0.1), ("post", (z > 0.3) & (z < 1.3)), ("head", z > 1.6)):
        assert parts.mask(name)[where].all()
    assert "a post, slim up to 0.7" in parts.reason
    assert guess(sign(width=0.1), up="+z").parts is None


# ---- kinds


def kind(cloud, **given):
    return guess(dataclasses.replace(cloud, means=cloud.means + torch.tensor(AWAY)), **{"up": "+z", **given})


@pytest.mark.parametrize(
    ("name", "make", "hold"),
    [
        ("flag", lambda: FlagScene(spacing=0.05).generate(), "-x"),
        ("cloth", lambda: FlagScene(spacing=0.05).generate(), "top"),
        ("person", lambda: figure(SKIN), "bottom"),
        ("person", lambda: figure((0.35, 0.25, 0.17)), "bottom"),
        ("rigid", lambda: figure(GREY, GREY), "bottom"),
        ("rigid", lambda: figure(BLUE), "bottom"),
        ("rigid", lambda: painted(full([0, 0, 0], [0.5, 0.4, 0.6]), GREY), "bottom"),
        ("rigid", lambda: painted(full([0, 0, 0], [0.5, 0.5, 0.6]), (0.7, 0.65, 0.2)), "bottom"),  # gold is no leaf
        ("shrub", lambda: painted(full([0, 0, 0], [0.5, 0.5, 0.6]), GREEN), "bottom"),
        ("conifer", cone, "bottom"),
        ("grass", tuft, "bottom"),
        ("hanging", lambda: painted(full([0, 0, 0], [0.3, 0.3, 1.0]), GREY), "top"),
    ],
)
def test_a_thing_is_of_its_kind(name, make, hold):
    found = kind(make(), hold=hold)
    assert found.kind == name, found.kind_reason
    assert found.longest_side == pytest.approx(KINDS[name].side)  # usual for its kind
    assert found.material == KINDS[name].material


def test_parts_have_the_materials_of_their_kind():
    plant = guess(potted_plant(), up="+z")
    parts = {part.name: part for part in plant.parts.parts.parts}
    assert plant.kind == "plant"
    assert (parts["stem"].E, parts["leaf"].E, parts["pot"].density) == (STEM_E, None, None)
    assert parts["stem"].damping_ratio == parts["leaf"].damping_ratio == KINDS["plant"].damping_ratio
    assert parts["leaf"].density == MATERIALS["leaf"].density
    assert guess(small_tree(), up="+z").kind == "tree"
    assert guess(flag_on_a_pole(), up="+z").kind == "flag"


def test_a_kind_or_a_material_may_be_given():
    cloud = painted(full([0, 0, 0], [0.5, 0.4, 0.6]), GREY)
    found = kind(cloud, hold="bottom", kind="shrub")
    assert (found.kind, found.kind_reason, found.longest_side) == ("shrub", "given", pytest.approx(1.2))
    assert kind(cloud, hold="bottom", kind="shrub", longest_side=3.0).longest_side == pytest.approx(3.0)
    assert kind(cloud, kind="hanging").hold.name == "top"
    silk = kind(FlagScene(spacing=0.05).generate(), material="silk", hold="-x")
    assert (silk.youngs_modulus, silk.thickness) == (MATERIALS["silk"].E, MATERIALS["silk"].thickness)
    assert (silk.sways, silk.real) == (False, True)
    for given, words in (
        ({"kind": "cactus"}, "`--kind` to be one of plant, succulent"),
        ({"look": "gale"}, "`--look` to be one of breeze, gusts, storm"),
        ({"material": "slk"}, "`--material` to be one of cotton, silk"),
    ):
        with value_error(words):
            kind(cloud, **given)


def test_frequency_falls_with_the_root_of_the_height():
    tree = KINDS["tree"]
    assert tree.first_frequency(16.0) == pytest.approx(tree.first_frequency(4.0) / 2)
    assert tree.area_mass(10.0) == pytest.approx(8.0)
    assert KINDS["rigid"].first_frequency(9.0) == 40.0
    assert KINDS["conifer"].first_frequency(20.0) == pytest.approx(386 * (20 / 53) / 20**2)
    assert KINDS["conifer"].first_frequency(4.0) == pytest.approx(0.99)  # no stiffer than the stiffest tenth of all
    assert KINDS["hanging"].first_frequency(0.25) == pytest.approx(math.sqrt(9.81 / 0.25) / (2 * math.pi), rel=0.01)
    assert KINDS["flag"].cloth
    assert not tree.cloth
    assert all({known.material, known.other} <= set(MATERIALS) for known in KINDS.values())
