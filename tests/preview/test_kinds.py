"""What kind of thing a small splat is taken for."""

import dataclasses
import math

import pytest
import torch
from small_scenes import GREEN
from things import AWAY, BLUE, GREY, SKIN, cone, figure, full, painted, small_tree, tuft

from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.preview.kinds import KINDS, STEM_E
from gaussian_swaying.preview.suggest import suggest
from gaussian_swaying.scenes.alocasia import AlocasiaScene
from gaussian_swaying.scenes.flag_on_stand import FlagOnStandScene
from gaussian_swaying.scenes.procedural import FlagScene


def kind(cloud, **given):
    given.setdefault("up", "+z")
    return suggest(dataclasses.replace(cloud, means=cloud.means + torch.tensor(AWAY)), **given)


@pytest.mark.parametrize(
    ("name", "make", "given"),
    [
        ("flag", lambda: FlagScene(spacing=0.05).generate(), {"hold": "-x"}),
        ("cloth", lambda: FlagScene(spacing=0.05).generate(), {"hold": "top"}),
        ("person", lambda: figure(SKIN), {"hold": "bottom"}),
        ("person", lambda: figure((0.35, 0.25, 0.17)), {"hold": "bottom"}),
        ("rigid", lambda: figure(GREY, GREY), {"hold": "bottom"}),
        ("rigid", lambda: figure(BLUE), {"hold": "bottom"}),
        ("rigid", lambda: painted(full([0, 0, 0], [0.5, 0.4, 0.6]), GREY), {"hold": "bottom"}),
        ("shrub", lambda: painted(full([0, 0, 0], [0.5, 0.5, 0.6]), GREEN), {"hold": "bottom"}),
        ("conifer", cone, {"hold": "bottom"}),
        ("grass", tuft, {"hold": "bottom"}),
        ("hanging", lambda: painted(full([0, 0, 0], [0.3, 0.3, 1.0]), GREY), {"hold": "top"}),
    ],
)  # fmt: skip
def test_a_thing_is_of_its_kind(name, make, given):
    found = kind(make(), **given)
    assert found.kind == name, found.kind_reason
    assert found.kind_reason
    assert found.longest_side == pytest.approx(KINDS[name].side)  # usual for its kind
    assert found.material == KINDS[name].material


def test_gold_is_no_leaf():
    """Yellow is greener than blue, and as green as red."""
    found = kind(painted(full([0, 0, 0], [0.5, 0.5, 0.6]), (0.7, 0.65, 0.2)), hold="bottom")
    assert found.kind == "rigid"


def test_a_plant_in_a_pot_and_a_tree():
    plant = AlocasiaScene(spacing=0.01).generate()
    plant = plant.select(plant.means[:, :2].norm(dim=-1) < 0.6)
    found = suggest(plant, up="+z")
    assert found.kind == "plant"
    stems = {part.name: part for part in found.parts.parts.parts}
    assert stems["stem"].E == STEM_E
    assert stems["leaf"].E is None
    assert stems["stem"].damping_ratio == stems["leaf"].damping_ratio == KINDS["plant"].damping_ratio
    assert stems["leaf"].density == MATERIALS["leaf"].density
    assert stems["pot"].density is None
    assert suggest(small_tree(), up="+z").kind == "tree"
    assert suggest(FlagOnStandScene(spacing=0.025).generate(), up="+z").kind == "flag"


def test_the_ground_around_a_plant_is_no_part_of_its_size():
    """Else a plant of 1 m on a floor of 28 m would be one of 4 cm."""
    scene = AlocasiaScene(spacing=0.01).generate()
    alone = scene.select(scene.means[:, :2].norm(dim=-1) < 0.6)
    found, other = suggest(scene, up="+z"), suggest(alone, up="+z")
    assert found.kind == "plant"
    assert found.longest_side == pytest.approx(other.longest_side, rel=0.2)
    assert 0.5 < found.longest_side <= 1.0


def test_a_kind_may_be_given():
    cloud = painted(full([0, 0, 0], [0.5, 0.4, 0.6]), GREY)
    found = kind(cloud, hold="bottom", kind="shrub")
    assert (found.kind, found.kind_reason, found.longest_side) == ("shrub", "given", pytest.approx(1.2))
    assert kind(cloud, hold="bottom", kind="shrub", longest_side=3.0).longest_side == pytest.approx(3.0)
    with pytest.raises(ValueError, match="`--kind` to be one of plant, succulent"):
        kind(cloud, kind="cactus")
    with pytest.raises(ValueError, match="`--look` to be one of breeze, gusts, storm"):
        kind(cloud, look="gale")


def test_frequency_falls_with_the_root_of_the_height():
    tree = KINDS["tree"]
    assert tree.first_frequency(16.0) == pytest.approx(tree.first_frequency(4.0) / 2)
    assert tree.area_mass(10.0) == pytest.approx(8.0)
    assert KINDS["rigid"].first_frequency(9.0) == 40.0
    assert KINDS["conifer"].first_frequency(20.0) == pytest.approx(386 * (20 / 53) / 20**2)
    assert KINDS["conifer"].first_frequency(4.0) == pytest.approx(0.99)  # no stiffer than the stiffest tenth of all
    assert KINDS["flag"].first_frequency(1.0) is None
    assert KINDS["flag"].cloth
    assert not tree.cloth
    assert KINDS["hanging"].first_frequency(0.25) == pytest.approx(math.sqrt(9.81 / 0.25) / (2 * math.pi), rel=0.01)
    for known in KINDS.values():
        assert known.source
        assert {known.material, known.other} <= set(MATERIALS)
