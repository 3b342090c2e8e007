"""The end that a film shows to be held."""

import numpy as np
import pytest
import torch
from small_scenes import plain_cloud

from gaussian_swaying.inverse.film import held_end, moving_box, moving_points
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.protocol import RenderOutput

pytest.importorskip("cv2")
CAMERA = look_at_camera((0.0, -3.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 40.0, 200, 160)
SPOTS = np.random.default_rng(1).integers(0, 255, (20, 25)).repeat(8, 0).repeat(8, 1)


def _filmed(shift):
    """A spotted sheet in the plane y = 0 that fills the middle of the picture; a pixel goes right by ``shift``."""
    row, column = np.mgrid[:160, :200]
    inside = (row >= 30) & (row < 130) & (column >= 40) & (column < 150)
    frames = []
    for k in range(8):
        moved = np.clip(np.round(column - k / 7 * shift(row, column)), 0, 199).astype(int)
        frames.append(np.where(inside, SPOTS[row, moved], 128).astype(np.uint8)[..., None].repeat(3, -1))
    alpha = torch.from_numpy(inside).float()[..., None]
    picture = RenderOutput(color=alpha.expand(-1, -1, 3), depth=3.0 * alpha, alpha=alpha)
    times = tuple(0.1 * k for k in range(8))
    return Footage("a", times, (CAMERA,) * 8, torch.from_numpy(np.stack(frames))), picture


@pytest.mark.parametrize(
    ("shift", "name"),
    [
        (lambda row, column: 12 * (column - 40) / 110, "-x"),
        (lambda row, column: 12 * (150 - column) / 110, "+x"),
        (lambda row, column: 12 * (row - 30) / 100, "top"),
        (lambda row, column: 12 * (130 - row) / 100, "bottom"),
    ],
)
def test_the_end_that_stands_still(shift, name):
    found, moves, others = held_end(*moving_points(*_filmed(shift)), up=(0.0, 0.0, 1.0))
    assert found == name
    assert moves < 3 < 6 < others


def room(shake):
    """A sheet that bends in front of a spotted wall that fills the picture, and the splat of both."""
    camera = look_at_camera((0.0, -3.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 40.0, 400, 320)
    row, column = np.mgrid[:320, :400]
    sheet = (row >= 80) & (row < 240) & (column >= 120) & (column < 280)
    front, wall = (np.random.default_rng(seed).integers(0, 255, (40, 50)).repeat(8, 0).repeat(8, 1) for seed in (2, 3))
    frames = []
    for k in range(8):
        moved = np.clip(np.round(column - k / 7 * 30 * (column - 120) / 160), 0, 399).astype(int)
        picture = np.where(sheet, front[row, moved], wall).astype(np.uint8)
        frames.append(np.roll(picture, (round(shake * np.sin(k)), round(shake * k / 7)), (0, 1)))
    images = torch.from_numpy(np.stack(frames))[..., None].expand(-1, -1, -1, 3).contiguous()
    depth = torch.from_numpy(np.where(sheet, 2.0, 3.0)).float()[..., None]
    picture = RenderOutput(color=torch.ones(320, 400, 3), depth=depth, alpha=torch.ones(320, 400, 1))
    every = torch.from_numpy(np.stack([column.ravel(), row.ravel()], 1) + 0.5).double()[::7]
    ray = torch.cat([every, torch.ones(len(every), 1).double()], 1) @ torch.linalg.inv(camera.intrinsics.double()).T
    local, view = ray * depth.flatten()[::7, None].double(), camera.world_to_camera.double()
    cloud = plain_cloud(((local - view[:3, 3]) @ view[:3, :3]).float(), -5.0)
    return Footage("a", tuple(0.1 * k for k in range(8)), (camera,) * 8, images), picture, cloud


@pytest.mark.parametrize("shake", [0, 3])
def test_what_moves_in_aroom(shake):
    """The box holds all of the sheet, also the end that is held, and nothing of the wall; a hand may shake."""
    video, picture, cloud = room(shake)
    places, moved = moving_points(video, picture)
    low, high = moving_box(places, moved, cloud)
    inside = ((cloud.means >= low) & (cloud.means <= high)).all(-1)
    sheet = cloud.means[:, 1] < -0.5  # a metre before the wall
    assert torch.equal(inside, sheet)
    chosen = ((places >= low) & (places <= high)).all(-1)
    assert held_end(places[chosen], moved[chosen], (0.0, 0.0, 1.0))[0] == "-x"


def test_there_is_no_box_where_all_moves():
    video, picture = _filmed(lambda row, column: 12 * (column - 40) / 110)
    places, moved = moving_points(video, picture)
    assert moving_box(places, moved, plain_cloud(places.float(), -5.0)) is None


def test_no_end_stands_still():
    """Most of it moves; or nothing does."""
    for shift in (lambda row, column: 4 + 8 * (abs(row - 80) < 20), lambda row, column: 1.0 * (column > 90)):
        assert held_end(*moving_points(*_filmed(shift)), up=(0.0, 0.0, 1.0)) is None
