"""Films as a fit takes them: the brightness of frames, which of them are changed, and what is said of it."""

from dataclasses import replace

import pytest
import torch
from handheld_films import drift, tripod, write_film
from shared import peak, seeded, value_error

from gaussian_swaying.inverse.plan import read_plan
from gaussian_swaying.inverse.registration import Background, gain_of, gains, prepared, with_gains
from gaussian_swaying.inverse.videos import Footage, read_videos

pytest.importorskip("cv2", reason="needs the extra [fit]")

FRAMES = 7


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
    found = gains(_film(camera, images), background)
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
    found = gains(_film(camera, images), background)
    assert found[1].tolist() == pytest.approx([0.7] * 3, abs=0.01)
    assert gains(_film(camera, [0 * picture] * 3), background) is None


def test_a_tripod_keeps_its_camera_and_loses_the_drift(room, tmp_path):
    """A camera that is said to move is looked for, though."""
    write_film(room, tmp_path, [tripod(200, 120)] * FRAMES, drift(FRAMES))
    (video,) = read_videos(tmp_path)
    (found,), (told,), doubts = prepared(room, [video])
    assert found.cameras is video.cameras
    assert doubts == []
    assert float(told.split("blue ")[1].split()[0]) == pytest.approx(0.65, abs=0.05)
    means = found.images.double().mean((1, 2))
    assert peak(means[-1] / means[0] - 1) < 0.05
    assert "held in a hand" in prepared(room, [video], hand_held=True)[1][0]


def test_many_frames_without_background_make_a_fit_doubtful(room, tmp_path):
    write_film(room, tmp_path, [tripod(200, 120)] * 10)
    (video,) = read_videos(tmp_path)
    for blank, doubts in ((2, 0), (3, 1)):
        images = video.images.clone()
        images[-blank:] = 90
        told = prepared(room, [replace(video, images=images)], hand_held=True)[2]
        assert [one.startswith(f"camera 0: {blank} of 10 frames show too little") for one in told] == [True] * doubts


def test_the_fit_file(tmp_path):
    file = tmp_path / "fit.yaml"
    lines = "base: [printed_flag]\nvideos: [film]\nunknowns: {wind.speed: [1, 9]}\n"
    file.write_text(lines + "hand_held: true\nalso_moves: tree\n")
    plan = read_plan(file)
    assert plan.hand_held is True
    assert plan.also_moves == ["tree"]
    file.write_text(lines)
    assert read_plan(file).hand_held is None
    file.write_text(lines + "hand_held: maybe\n")
    with pytest.raises(TypeError, match=r"`hand_held` of .*fit\.yaml to be true or false or None, but got 'maybe'"):
        read_plan(file)
    file.write_text(lines + "wind_changes: true\n")
    with value_error(r"`fit\.wind_changes` is gone: use `until`"):
        read_plan(file)
