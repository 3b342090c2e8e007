"""The end that a film shows to be held."""

import numpy as np
import pytest
import torch

from gaussian_swaying.fitting.held import held_end
from gaussian_swaying.fitting.videos import Footage
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
    found = held_end(*_filmed(shift), up=(0.0, 0.0, 1.0))
    assert found.name == name
    assert found.moves < 3 < 6 < found.others


def test_no_end_stands_still():
    """All of it moves; or nothing does."""
    assert held_end(*_filmed(lambda row, column: 10.0), up=(0.0, 0.0, 1.0)) is None
    assert held_end(*_filmed(lambda row, column: 1.0 * (column > 90)), up=(0.0, 0.0, 1.0)) is None
