"""A film and a splat: size, focal length, when it begins to move, what moves, and the end that is held."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from shared import value_error
from small_scenes import plain_cloud

from gaussian_swaying.inverse import from_film as films
from gaussian_swaying.inverse.from_film import begins_to_move, held_end, moving_box, moving_points, open_film
from gaussian_swaying.inverse.videos import Footage
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


def test_a_hand_that_shakes_in_a_room(tmp_path):
    """The splat fills the picture: most of it stands still, and tells where the camera is."""
    video, picture, _ = room(0)
    frames = [video.images[max(0, k - 20) // 2].numpy() for k in range(35)]
    frames = [
        np.roll(frame, (round(3 * np.sin(k)), round(4 * np.sin(0.7 * k))), (0, 1)) for k, frame in enumerate(frames)
    ]
    film = open_film(_film(tmp_path / "a.mp4", frames))
    assert begins_to_move(film, picture, video.cameras[0]) == pytest.approx(0.88, abs=0.13)
    still = open_film(_film(tmp_path / "b.mp4", frames[:20]))
    assert begins_to_move(still, picture, video.cameras[0]) is None


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
