"""Gains of frames against the splat: pictures that were made darker and warmer by known amounts."""

import pytest
import torch
from handheld_films import drift, tripod
from shared import peak, seeded

from gaussian_swaying.inverse.hand import Background, gain_of, gains, with_gains
from gaussian_swaying.inverse.videos import Footage

pytest.importorskip("cv2", reason="needs the extra [fit]")

FRAMES = 5


@pytest.fixture
def background(room):
    return Background(room)


@pytest.fixture
def still(background):
    """A camera, the splat as it sees it in grey levels, and the mask of what stands still."""
    camera = tripod(200, 120)
    picture, mask = background.draw(camera)
    return camera, 255 * picture.color.double(), mask


def _film(camera, images):
    shots = torch.stack([image.round().clamp(0, 255).to(torch.uint8) for image in images])
    return Footage("one", tuple(k / 30 for k in range(len(images))), (camera,) * len(images), shots)


def test_the_gain_of_each_frame_is_found(background, still):
    """With noise, and something dark that moves over a fifth of the background."""
    camera, picture, mask = still
    generator, true = seeded(0), drift(FRAMES)
    images = [gain * picture + 3 * torch.randn(picture.shape, generator=generator) for gain in true]
    for k, image in enumerate(images):
        image[:, 5 * k : 5 * k + 40] *= 0.4
    found, unseen = gains(_film(camera, images), background)
    assert unseen == ()
    assert peak(found / true - 1) < 0.02
    video = with_gains(torch.stack(images).round().clamp(0, 255).to(torch.uint8), true)
    assert video.dtype == torch.uint8
    inside = mask & (torch.arange(200) > 80)
    assert peak(video[:, inside].double().mean((0, 1)) / picture[inside].mean(0) - 1) < 0.01


def test_what_is_cut_off_tells_nothing(background, still):
    _camera, picture, mask = still
    found = gain_of((1.5 * picture).clamp(0, 255), picture, mask)
    assert found.tolist() == pytest.approx([1.5] * 3, abs=0.01)


def test_a_frame_without_background_has_the_gain_of_its_neighbours(background, still):
    camera, picture, _ = still
    images = [0.8 * picture, 0 * picture, 0.6 * picture]
    found, unseen = gains(_film(camera, images), background)
    assert unseen == (1,)
    assert found[1].tolist() == pytest.approx([0.7] * 3, abs=0.01)
    assert gains(_film(camera, [0 * picture] * 3), background) is None
