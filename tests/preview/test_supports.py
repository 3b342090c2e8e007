"""Flags on their poles, what hangs from a cord, and trees: parts are proposed where they are sure."""

import dataclasses

import pytest
import torch
from shared import unit
from small_scenes import coloured, plain_cloud, started
from things import sign, small_tree, washing_line

from gaussian_swaying.preview.suggest import suggest, visible_weight
from gaussian_swaying.preview.supports import flag_on_pole, sheet_between_posts, standing_parts
from gaussian_swaying.scenes.flag_on_stand import FlagOnStandScene
from gaussian_swaying.scenes.procedural import FlagScene

UP = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def tree():
    return small_tree(0.01)


def all_of(cloud):
    return torch.ones(len(cloud), dtype=torch.bool)


def lamp(radius=0.006):
    """A ball on a cord of 0.6 m under a plate."""
    draw = torch.Generator().manual_seed(0)
    angle, share = 6.2832 * torch.rand(600, generator=draw), torch.rand(600, generator=draw)
    cord = torch.stack([radius * angle.cos(), radius * angle.sin(), 0.24 + 0.66 * share], -1)
    plate = torch.stack([0.04 * angle.sin(), 0.04 * angle.cos() * share, 0.9 + 0.02 * share], -1)
    ball = unit(1200, 3, generator=draw, dtype=torch.float32) * 0.12
    ball[:, 2] += 0.12
    return plain_cloud(torch.cat([cord, plate, ball]) + torch.tensor([3.0, 4.0, 5.0]), -4.0, logit=2.0)


@pytest.mark.parametrize("yaw", [0.0, 30.0, 200.0])
def test_a_flag_and_its_pole(yaw):
    scene = FlagOnStandScene(spacing=0.025, yaw=yaw)
    cloud, cloth = scene.generate(), len(FlagScene(spacing=0.025).generate())
    found, side = flag_on_pole(cloud, all_of(cloud), UP)
    assert [(part.name, part.role) for part in found.parts.parts] == [("cloth", "soft"), ("pole", "still")]
    label = found.parts.labels
    assert float((label[:cloth] == 0).double().mean()) > 0.95
    assert float((label[cloth:] == 1).double().mean()) == 1.0
    away = cloud.means[:cloth].mean(0) - cloud.means[cloth:].mean(0)
    away[2] = 0.0
    assert float(torch.tensor(side) @ (away / away.norm())) == pytest.approx(-1.0, abs=0.02)
    assert "alone over 0.6" in found.reason


def test_any_axis_may_be_up_and_the_pole_may_be_below_only():
    cloud = FlagOnStandScene(spacing=0.025).generate()
    cloud = cloud.select(cloud.means[:, 2] < 0.8)
    x, y, z = cloud.means.unbind(-1)
    turned = dataclasses.replace(cloud, means=torch.stack([x, -z, y], -1) * 7 + torch.tensor([3.0, -2.0, 1.0]))
    _, side = flag_on_pole(turned, all_of(turned), (0.0, -1.0, 0.0))
    assert side == pytest.approx((-1.0, 0.0, 0.0))


def test_a_flag_without_its_pole_or_with_two_or_on_a_rod_has_no_pole():
    for kind in ("posts", "rod", "none"):
        cloud = FlagOnStandScene(stand=kind).generate()
        assert flag_on_pole(cloud, all_of(cloud), UP) is None
        assert (suggest(cloud).parts is None) == (kind != "posts")
    assert suggest(FlagScene().generate()).parts is None


def test_the_starter_moves_the_cloth_and_not_the_pole(tmp_path):
    cloud = FlagOnStandScene(spacing=0.025).generate()
    guess = suggest(cloud, up="+z", quality="draft")
    assert guess.hold.end == "side"
    assert guess.hold.confidence == "high"
    assert guess.hold.option == "-x"
    assert guess.pin is not None
    assert guess.sheet
    assert guess.longest_side == pytest.approx(1.2 * guess.metres_per_unit, rel=0.05)  # of the cloth
    assert guess.metres_per_unit == pytest.approx(
        1 / float((cloud.means.amax(0) - cloud.means.amin(0)).amax()), rel=1e-3
    )
    simulation = started(guess, cloud, tmp_path)
    assert [type(pin).__name__ for pin in simulation.solver.boundaries] == ["PinnedRegion"]
    last = list(simulation.frames(5))[-1]
    moved = (last.gaussians.means - simulation.scene.rest().means).norm(dim=-1)
    parts = simulation.scene.parts
    assert float(moved[parts.mask("pole")].max()) == 0.0
    assert float(moved[parts.mask("cloth")].max()) > 0.01
    edge = parts.mask("cloth") & (cloud.means[:, 0] < 0.02)
    assert float(moved[edge].max()) < 0.2 * float(moved.max())
    assert suggest(cloud, up="+z", hold="-x").parts is None


def test_posts_of_a_washing_line_stand():
    moving, means = washing_line()
    cloud = plain_cloud(means, -4.0, logit=2.0)
    found = sheet_between_posts(cloud, all_of(cloud), UP)
    assert [(part.name, part.role) for part in found.parts.parts] == [("cloth", "soft"), ("post", "still")]
    label = found.parts.labels
    assert bool((label[:6000] == 0).all())
    assert float((label[6000 : len(moving)] == 0).double().mean()) > 0.8  # the line, but for its ends
    assert bool((label[len(moving) :] == 1).all())
    suggestion = suggest(cloud, UP)
    assert (suggestion.kind, suggestion.hold.end) == ("cloth", "top")
    assert suggestion.metres_per_unit == pytest.approx(2.5 / 2.3, rel=0.05)  # with the feet


def test_a_sheet_without_two_posts_has_none():
    moving, one = washing_line((0.0,))
    curtain = moving * torch.tensor([1.0, 1.0, 2.0])  # down to the ground
    for means in (moving, one, curtain):
        cloud = plain_cloud(means, -4.0, logit=2.0)
        assert sheet_between_posts(cloud, all_of(cloud), UP) is None


def test_what_hangs_from_a_cord():
    cloud = lamp()
    guess = suggest(cloud, up="+z")
    parts, height = guess.parts.parts, cloud.means[:, 2] - 5.0
    assert [(part.name, part.role) for part in parts.parts] == [("hook", "held"), ("cord", "soft"), ("body", "rigid")]
    assert bool(parts.mask("hook")[height > 0.88].all())
    assert bool(parts.mask("cord")[(height > 0.32) & (height < 0.8)].all())
    assert bool(parts.mask("body")[height < 0.22].all())
    assert guess.pin is None
    assert guess.fixed
    assert guess.kind == "hanging"
    assert guess.parts.reason == "it hangs from its upper end by a cord"
    thick = suggest(lamp(radius=0.1), up="+z", hold="top")
    assert "a neck of 0." in thick.parts.reason


def test_a_tree(tree):
    guess = suggest(tree, up="+z")
    parts, (x, y, z) = guess.parts.parts, tree.means.unbind(-1)
    across = torch.hypot(x, y)
    assert [(part.name, part.role) for part in parts.parts] == [("foot", "held"), ("wood", "soft"), ("leaf", "soft")]
    assert bool(parts.mask("foot")[z < 0.38].all())
    assert float(parts.mask("wood")[(across < 0.1) & (z > 0.48) & (z < 0.7)].double().mean()) > 0.99
    assert float(parts.mask("leaf")[z > 1.5].double().mean()) > 0.9
    assert guess.pin is None
    assert guess.hold.end == "bottom"


def test_a_sign_on_a_post():
    cloud = sign()
    guess = suggest(cloud, up="+z")
    assert guess.hold.end == "bottom"
    parts, z = guess.parts.parts, cloud.means[:, 2]
    assert [(part.name, part.role) for part in parts.parts] == [("foot", "held"), ("post", "soft"), ("head", "soft")]
    assert bool(parts.mask("foot")[z < 0.1].all())
    assert bool(parts.mask("post")[(z > 0.3) & (z < 1.3)].all())
    assert bool(parts.mask("head")[z > 1.6].all())
    assert "a post, slim up to 0.7" in guess.parts.reason
    thick = sign(width=0.1)
    assert suggest(thick, up="+z").parts is None


def test_a_trunk_is_no_pot_and_a_tree_must_be_green(tree):
    """A trunk is round and brown below green leaves, as a pot is, but slender."""
    assert suggest(tree, up="+z").parts.parts.parts[0].name == "foot"
    dead = coloured(tree, (0.5, 0.4, 0.3), all_of(tree))
    bush = coloured(tree, (0.2, 0.5, 0.2), all_of(tree))
    for cloud in (dead, bush):
        assert standing_parts(cloud, all_of(cloud), UP, visible_weight(cloud), 0.1) is None
