import math
from functools import partial

import numpy as np
import pytest
import torch

from gaussian_swaying.player.pictures import FLIP, Eye, PictureSize, draw, under_cursor
from gaussian_swaying.rendering.passes import PASSES
from gaussian_swaying.simulation.draw import View


def told_of(camera, scene):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = scene.frame.rotation @ camera.world_to_camera[:3, :3].double().mT @ FLIP
    size = scene.size * scene.frame.metres_per_unit
    matrix[:3, 3] = scene.frame.point_to_sim(camera.position.double()) / size
    fov = 2 * math.degrees(math.atan(0.5 * camera.height / float(camera.intrinsics[1, 1])))
    sides = {"size": [camera.width, camera.height], "near": 0.01 / scene.size}
    return sides | {"matrix": matrix.T.flatten().tolist(), "fov": fov}


def _pose(session):
    """The camera of the configuration: as a browser tells it, by its width and height, and itself."""
    scene, camera = session.simulation.scene, session.simulation.painter.camera_at(0)
    eye = Eye.told(told_of(camera, scene))
    return partial(eye.camera, scene), camera


def test_the_picture_is_that_of_the_simulation(session):
    camera_of, camera = _pose(session)
    picture = draw(session.snapshot, camera_of(camera.width, camera.height))
    with torch.inference_mode():
        wanted = session.simulation.painter.render(session.snapshot.state, 0).color
    assert picture.dtype == np.uint8
    difference = np.abs(picture.astype(float) - 255 * wanted.clamp(0, 1).numpy())
    assert difference.max() < 2.0  # one half by rounding, and the camera in float32


SHOWN = [name for name, own in PASSES.items() if not own.air]


@pytest.mark.parametrize("shown", SHOWN)
def test_everything_that_can_be_shown_is_different(session, shown):
    camera_of, _ = _pose(session)
    camera = camera_of(64, 36)
    picture = draw(session.snapshot, camera, shown)
    assert picture.shape == (36, 64, 3)
    others = [draw(session.snapshot, camera, other) for other in SHOWN if other != shown]
    assert all(np.abs(picture.astype(int) - other.astype(int)).max() > 30 for other in others)


def test_streaks_of_air_are_those_of_the_render(session):
    camera_of, camera = _pose(session)
    small = camera_of(192, 108)
    with_air, without = (draw(session.snapshot, small, shown).astype(int) for shown in ("wind", "color"))
    drawn = np.abs(with_air - (0.75 * without + 0.25 * 255)).max(-1) > 3
    assert 0.02 < drawn.mean() < 0.8
    painter, state = session.snapshot.simulation.painter, session.snapshot.state
    with torch.inference_mode():
        wanted = View(painter, state, painter.deformed(state), camera).wind()
    found = draw(session.snapshot, camera_of(camera.width, camera.height), "wind")
    apart = np.abs(found.astype(float) - 255 * wanted.clamp(0, 1).numpy()).max(-1)
    assert (apart > 2.0).mean() < 1e-3  # the camera in float32: the ends of a few streaks


@pytest.mark.parametrize("shown", ["normal", "force"])
def test_edges_of_passes_fade(session, shown):
    """Between the object and the black around it some pixels are in between; a hard edge has none."""
    camera_of, camera = _pose(session)
    small = camera_of(camera.width // 2, camera.height // 2)
    picture = draw(session.snapshot, small, shown).max(-1).astype(float)
    inside = np.median(picture[picture > 0])
    between = ((picture > 0.1 * inside) & (picture < 0.8 * inside)).sum()
    outline = np.abs(np.diff((picture > 0.5 * inside).astype(int), axis=0)).sum()
    assert between > 0.5 * outline


def test_the_cursor_finds_what_is_under_it(session):
    place = under_cursor(session.snapshot, [0.6, -3.0, 0.4], [0.0, 1.0, 0.0])
    assert place == pytest.approx([0.6, 0.0, 0.4], abs=0.04)
    assert under_cursor(session.snapshot, [0.6, -3.0, 3.0], [0.0, 1.0, 0.0]) is None
    assert under_cursor(session.snapshot, [0.6, -3.0, 0.4], [0.0, -1.0, 0.0]) is None  # behind the eye


def test_pictures_get_smaller_where_they_take_long():
    size = PictureSize(seconds=0.1, largest=1000)
    assert size.fit(2000, 1000) == (1000, 500)
    size.took(0.2)  # twice as long as it may: the next smaller ones have about half as many pixels
    assert size.fit(2000, 1000) == (750, 376)
    size.took(0.5)
    size.took(5.0)
    assert size.fit(2000, 1000) == (250, 124)
    assert size.fit(300, 200) == (144, 96)  # not too small to be read
    assert size.fit(2000, 1000, still=True) == (1000, 500)
    assert size.fit(1, 2_000_000) == size.fit(1, 2_000_000, still=True) == (2, 1000)  # nor too large
    for _ in range(10):
        size.took(0.01)
    assert size.fit(400, 300) == (400, 300)
