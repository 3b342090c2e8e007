"""A film: size, focal length, and when it begins to move."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from shared import value_error

from gaussian_swaying.inverse import from_film as films
from gaussian_swaying.inverse.from_film import begins_to_move, open_film
from gaussian_swaying.recording.video import VideoEncoder
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.protocol import RenderOutput

pytest.importorskip("cv2", reason="needs the extra [fit]")


def _film(path, frames, rate=25):
    encoder = VideoEncoder(path, rate)
    for frame in frames:
        encoder.write(frame)
    encoder.finish()
    return path


def _square(left, light=1.0, noise=0.0, size=(96, 160)):
    """A striped square on grey, at a place."""
    picture = np.full((*size, 3), 90.0)
    stripes = 60 + 120 * (np.arange(40) // 4 % 2)
    picture[30:70, left : left + 40] = stripes[None, :, None]
    picture = picture * light + noise * np.random.default_rng(int(left * 7 + 100 * light)).standard_normal(
        picture.shape
    )
    return picture.clip(0, 255).astype(np.uint8)


def _moves(path):
    """The time at which the square, which is drawn at its first place, begins to move."""
    alpha = torch.zeros(96, 160, 1)
    alpha[30:70, 60:100] = 1.0
    camera = look_at_camera((0.0, -3.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 40.0, 160, 96)
    return begins_to_move(open_film(path), RenderOutput(alpha.expand(-1, -1, 3), alpha, 3 * alpha), camera)


def test_the_time_at_which_it_moves(tmp_path):
    """Noise and a brighter light are no motion."""
    still = [_square(60, 1.0 + 0.02 * (k % 3), 3.0) for k in range(20)]
    moving = [_square(60 + 2 * k, 1.0, 3.0) for k in range(1, 10)]
    assert _moves(_film(tmp_path / "a.mp4", still + moving)) == pytest.approx(0.8, abs=0.05)
    assert _moves(_film(tmp_path / "b.mp4", still)) is None


def test_the_time_at_which_a_film_with_a_variable_frame_rate_moves(tmp_path):
    """At rest it has 10 frames a second, in motion 50."""
    path = _film(tmp_path / "all.mp4", [_square(60)] * 50 + [_square(60 + 2 * k) for k in range(1, 30)], 50)
    kept = "select='lt(n,50)*not(mod(n,5))+gte(n,50)'"
    words = ["-v", "error", "-i", str(path), "-vf", kept, "-c:v", "libx264", str(tmp_path / "a.mp4")]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words], check=True)
    assert _moves(tmp_path / "a.mp4") == pytest.approx(1.0, abs=0.1)


def test_what_moves_beside_the_object_does_not_count(tmp_path):
    frames = [_square(60) for _ in range(20)]
    for k, frame in enumerate(frames):
        frame[80:96, 4 * k : 4 * k + 10] = 255
    assert _moves(_film(tmp_path / "a.mp4", frames)) is None


def test_a_hand_that_shakes_is_no_motion(tmp_path):
    """The background shows how it shakes; without one, it cannot be told from motion."""
    spots = np.random.default_rng(0).integers(40, 200, (24, 40)).repeat(4, 0).repeat(4, 1)[..., None]

    def frames(background):
        for k in range(30):
            picture = _square(60 + 2 * max(0, k - 19))
            empty = np.asarray(picture == 90).all(-1, keepdims=True)
            if background:
                picture = np.where(empty, spots, picture).astype(np.uint8)
            yield np.roll(picture, (round(1.5 * np.sin(k)), round(2 * np.sin(0.7 * k))), (0, 1))

    assert _moves(_film(tmp_path / "a.mp4", frames(True))) == pytest.approx(0.8, abs=0.1)
    assert _moves(_film(tmp_path / "b.mp4", frames(False))) < 0.2


def room():
    """Frames of a sheet that bends in front of a spotted wall that fills the picture, and the splat of both."""
    camera = look_at_camera((0.0, -3.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 1), 40.0, 400, 320)
    row, column = np.mgrid[:320, :400]
    sheet = (row >= 80) & (row < 240) & (column >= 120) & (column < 280)
    front, wall = (np.random.default_rng(seed).integers(0, 255, (40, 50)).repeat(8, 0).repeat(8, 1) for seed in (2, 3))
    frames = []
    for k in range(8):
        moved = np.clip(np.round(column - k / 7 * 30 * (column - 120) / 160), 0, 399).astype(int)
        frames.append(np.where(sheet, front[row, moved], wall).astype(np.uint8)[..., None].repeat(3, -1))
    depth = torch.from_numpy(np.where(sheet, 2.0, 3.0)).float()[..., None]
    picture = RenderOutput(color=torch.ones(320, 400, 3), depth=depth, alpha=torch.ones(320, 400, 1))
    return frames, picture, camera


def test_a_hand_that_shakes_in_a_room(tmp_path):
    """The splat fills the picture: most of it stands still, and tells where the camera is."""
    images, picture, camera = room()
    frames = [images[max(0, k - 20) // 2] for k in range(35)]
    frames = [
        np.roll(frame, (round(3 * np.sin(k)), round(4 * np.sin(0.7 * k))), (0, 1)) for k, frame in enumerate(frames)
    ]
    film = open_film(_film(tmp_path / "a.mp4", frames))
    assert begins_to_move(film, picture, camera) == pytest.approx(0.88, abs=0.13)
    still = open_film(_film(tmp_path / "b.mp4", frames[:20]))
    assert begins_to_move(still, picture, camera) is None


def test_a_large_film_is_read_in_reduced_size(tmp_path, monkeypatch):
    monkeypatch.setattr(films, "SIDE", 80)
    narrow = _film(tmp_path / "narrow.mp4", [np.zeros((16, 1600, 3), np.uint8)] * 2)
    with value_error(r"narrow\.mp4 are read with 80 x 1 pixels, and an object needs 16"):
        open_film(narrow)
    film = open_film(_film(tmp_path / "a.mp4", [_square(60)] * 5))
    assert (film.size, film.full, film.fps) == ((80, 48), 2.0, 25.0)
    frame = film.first
    assert frame.shape == (48, 80, 3)
    assert float(frame[5, 5].float().mean()) == pytest.approx(90, abs=4)


def test_the_focal_length_of_a_phone(tmp_path):
    path = _film(tmp_path / "a.mp4", [_square(60)] * 3)
    assert open_film(path).focal is None
    tag = "com.apple.quicktime.camera.focal_length.35mm_equivalent=26"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-c", "copy", "-movflags", "use_metadata_tags"]
    subprocess.run([*command, "-metadata", tag, str(tmp_path / "b.mp4")], check=True, capture_output=True)
    assert open_film(tmp_path / "b.mp4").focal == 26.0


def test_no_film(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no film")
    with value_error(r"a\.mp4 cannot be read"):
        open_film(tmp_path / "a.mp4")
