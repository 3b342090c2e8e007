"""The still background: what it is, and what is left out of it."""

import math

import pytest
import torch
from handheld_films import tripod, write_base
from shared import value_error

from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.inverse.registration import Background
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.scenes import GivenScene
from gaussian_swaying.simulation.body import Scene
from gaussian_swaying.simulation.simulation import Simulation

pytest.importorskip("cv2", reason="needs the extra [fit]")


def test_what_moves_and_what_it_may_reach_is_left_out(room):
    scene, camera, background = room.scene, tripod(320, 180), Background(room)
    assert background.exists
    _picture, still = background.draw(camera)
    assert still.shape == (180, 320)
    assert 0.3 < still.double().mean() < 0.8
    column, row = project(scene.rest().means[scene.moving], camera)[0].long().unbind(1)
    assert not still[row, column].any()
    left, right = int(column.min()), int(column.max())
    reach = (right - left) // 5  # nearer than a quarter of its width
    middle = int(row.median())
    assert not still[middle, left - reach : right + reach].any()
    assert still[middle, : left - (right - left) // 2].all()


def test_a_part_that_moves_too_is_left_out(walls):
    cloud = Scene(ply=walls.parent / "room.ply").cloud()
    far = cloud.means[:, 1] > 0.3
    near = (cloud.means[:, 1].abs() < 0.05) & (cloud.means[:, 0] < 0.5)
    labels = torch.where(near, 0, torch.where(far, 1, 2))
    parts = Parts(labels, [Part("flag"), Part("tree", "still"), Part("house", "still")])
    scene = Scene(generator=GivenScene(cloud), parts=parts, metres_per_unit=1.0)
    simulation = Simulation(scene, wind=[4, 3, 0], device="cpu")
    camera = tripod(320, 180)
    whole, house = (Background(simulation, names).draw(camera)[1] for names in ((), ("tree",)))
    assert (house <= whole).all()
    assert 0 < int(house.sum()) < 0.5 * int(whole.sum())
    assert not Background(simulation, ["tree", "house"]).exists
    with value_error("no part 'cat': use one of 'flag', 'tree', 'house'"):
        Background(simulation, ["cat"])


def test_a_splat_that_moves_as_a_whole_has_none(tmp_path):
    simulation = Simulation.from_yaml(write_base(tmp_path, wall=math.inf), device="cpu")
    assert not Background(simulation).exists
    with value_error(r"the scene has no parts: set `scene\.parts`"):
        Background(simulation, ["tree"])
