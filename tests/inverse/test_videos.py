"""Videos with cameras: what is read, and the sentence for what cannot be."""

import json
import shutil
import subprocess
from fractions import Fraction

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from shared import double, value_error
from small_films import FRAMES, cameras

from gaussian_swaying.inverse import videos
from gaussian_swaying.inverse.videos import frame_times, read_videos


def test_two_cameras(own):
    left, right = read_videos(own / "video")
    assert (left.name, right.name) == ("left", "right")
    assert left.images.shape == (FRAMES, 120, 200, 3)
    assert left.size == (200, 120)
    assert frame_times([left, right]) == pytest.approx([k / 24 for k in range(FRAMES)], abs=1e-6)
    wanted = cameras()["left"]
    assert torch.allclose(left.cameras[0].world_to_camera, wanted.world_to_camera, atol=1e-5)
    assert torch.allclose(left.cameras[0].intrinsics, wanted.intrinsics, atol=1e-4)


def test_a_video_file(own, tmp_path):
    given = json.loads((own / "video/transforms.json").read_text())
    entry = {name: value for name, value in given["frames"][0].items() if name != "file_path"}
    pictures = np.stack([iio.imread(own / f"video/left_{k:04d}.png") for k in range(FRAMES)])
    iio.imwrite(tmp_path / "left.mp4", np.pad(pictures, ((0, 0), (0, 8), (0, 8), (0, 0))), fps=24)
    entry |= {"video_path": "left.mp4", "w": 208, "h": 128, "time": 2.0}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [entry]}))
    (film,) = read_videos(tmp_path)
    assert film.times == pytest.approx([k / 24 for k in range(FRAMES)], abs=1e-4)
    assert film.images.shape == (FRAMES, 128, 208, 3)
    assert (film.images[3, :120, :200].float() - pictures[3].astype("f4")).abs().mean() < 6


def test_a_lens_with_distortion_and_pictures_beside_a_film(own, tmp_path):
    """A film is undistorted as stills are; one file may have both, for two cameras."""
    given = json.loads((own / "video/transforms.json").read_text())["frames"]
    stills = [frame | {"k1": 0.2} for frame in given if frame["camera"] == "left"]
    for frame in stills:
        pixels = np.pad(iio.imread(own / "video" / frame["file_path"])[..., :3], ((0, 8), (0, 8), (0, 0)))
        iio.imwrite(tmp_path / frame["file_path"], pixels)
    names = [tmp_path / frame["file_path"] for frame in stills]
    iio.imwrite(tmp_path / "film.mp4", np.stack([iio.imread(name) for name in names]), fps=24)
    stills = [frame | {"w": 208, "h": 128} for frame in stills]
    first = {name: value for name, value in stills[0].items() if name != "file_path"}
    film = first | {"video_path": "film.mp4", "camera": "film"}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [film, *stills]}))
    filmed, taken = read_videos(tmp_path)
    assert (filmed.name, taken.name) == ("film", "left")
    assert filmed.size == taken.size
    assert filmed.size != (208, 128)
    assert torch.equal(filmed.cameras[0].intrinsics, taken.cameras[0].intrinsics)
    assert torch.equal(filmed.cameras[0].world_to_camera, taken.cameras[0].world_to_camera)
    assert (filmed.images.float() - taken.images.float()).abs().mean() < 6


def test_bad_videos(own, tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_videos(tmp_path / "nowhere")
    with value_error(r"no transforms.json"):
        read_videos(tmp_path)
    shutil.copytree(own / "video", tmp_path / "video")
    file = tmp_path / "video/transforms.json"
    given = json.loads(file.read_text())
    for change, words in (
        (lambda frame: frame.pop("time"), r"frames\[0\].time"),
        (lambda frame: frame.pop("camera"), "two frames"),
    ):
        other = json.loads(json.dumps(given))
        for frame in other["frames"]:
            change(frame)
        file.write_text(json.dumps(other))
        with value_error(words):
            read_videos(tmp_path / "video")


def test_pictures_that_are_missing(own, tmp_path):
    """They do not matter for a camera that is not wanted."""
    shutil.copytree(own / "video", tmp_path, dirs_exist_ok=True)
    for k in (3, 7):
        (tmp_path / f"left_{k:04d}.png").unlink()
    with value_error(r"^2 of the pictures of `videos` do not exist, the first .*left_0003\.png: put"):
        read_videos(tmp_path)
    assert len(read_videos(tmp_path, ["right"])[0].times) == FRAMES


def _film(folder, size, frames, *, says=None, **fields):
    """A grey film of some hundred bytes a second, and its transforms.json; ``says`` replaces its size there."""
    width, height = size
    source = f"color=c=gray:s={width}x{height}:r=30:d={frames / 30}"
    words = ["-y", "-v", "error", "-f", "lavfi", "-i", source, "-c:v", "libx264", "-preset", "ultrafast"]
    path = folder / f"film{len(list(folder.glob('*.mp4')))}.mp4"
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words, "-pix_fmt", "yuv420p", str(path)], check=True)
    width, height = says or size
    entry = {"video_path": path.name, "w": width, "h": height, "fl_x": 50.0, "transform_matrix": np.eye(4).tolist()}
    file = folder / "transforms.json"
    given = json.loads(file.read_text())["frames"] if file.exists() else []
    file.write_text(json.dumps({"frames": [*given, entry | fields]}))
    return path


@pytest.fixture
def decoded(monkeypatch):
    """How many bytes of pixels ffmpeg delivered, for each film."""
    counted = {}
    read = imageio_ffmpeg.read_frames

    def counting(path, **settings):
        for item in read(path, **settings):
            counted[path.name] = counted.get(path.name, 0) + (0 if isinstance(item, dict) else len(item))
            yield item

    monkeypatch.setattr(imageio_ffmpeg, "read_frames", counting)
    return counted


def test_a_film_that_says_it_is_too_long_is_not_decoded(tmp_path, monkeypatch, decoded):
    path = _film(tmp_path, (64, 64), 300)
    monkeypatch.setattr(videos, "MOST_BYTES", 300 * 3 * 64 * 64)
    (film,) = read_videos(tmp_path)
    assert len(film.times) == 300
    assert decoded.pop(path.name) == film.images.numel()
    monkeypatch.setattr(videos, "MOST_BYTES", videos.MOST_BYTES - 1)
    with value_error(r"film0.mp4, 64 x 64.*cut them"):
        read_videos(tmp_path)
    assert decoded == {path.name: 0}


def test_a_film_that_is_longer_than_it_says(tmp_path, monkeypatch, decoded):
    """An attacker writes the header."""
    read = imageio_ffmpeg.read_frames

    def lying(path, **settings):
        for item in read(path, **settings):
            yield item | {"duration": 0.0} if isinstance(item, dict) else item

    monkeypatch.setattr(imageio_ffmpeg, "read_frames", lying)
    monkeypatch.setattr(videos, "MOST_BYTES", 100 * 3 * 64 * 64)
    path = _film(tmp_path, (64, 64), 3000)
    with value_error("GiB of pixels together"):
        read_videos(tmp_path)
    assert decoded[path.name] == 101 * 3 * 64 * 64


def test_a_part_of_a_film_at_half_its_size(tmp_path, decoded):
    """Only that part is delivered by ffmpeg, however long the film is."""

    path = _film(tmp_path, (64, 32), 300, says=(32, 16), begin=4.0, seconds=0.5)
    bright = np.repeat(np.arange(300, dtype=np.uint8) % 200 + 20, 64 * 32 * 3).reshape(300, 32, 64, 3)
    iio.imwrite(path, bright, fps=24)
    (film,) = read_videos(tmp_path)
    assert film.images.shape == (12, 16, 32, 3)
    assert film.images[:, 8, 16, 1].float().numpy() == pytest.approx(np.arange(96, 108) + 20, abs=2.5)
    assert decoded[path.name] == film.images.numel()
    assert film.times == pytest.approx([k / 24 for k in range(12)])


def _variable(path):
    """A film of 3 s, grey by its time: 20 frames a second, then 60, then 15."""
    source = "color=c=black:s=64x64:r=60:d=3,geq=lum='20+N':cb=128:cr=128"
    kept = "select='lt(n,60)*not(mod(n,3))+between(n,60,79)+gt(n,79)*not(mod(n,4))'"
    words = ["-y", "-v", "error", "-f", "lavfi", "-i", f"{source},{kept}", "-c:v", "libx264", "-qp", "1"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words, "-pix_fmt", "yuv420p", str(path)], check=True)


@pytest.mark.parametrize(
    ("size", "fields", "words"),
    [
        ((64, 32), {"fps": 1e9}, r"`fps`.* 1e\+09: set it from 0.001 to 1e\+06 1/s"),
        ((64, 32), {"time": 1e308}, r"`time`.* 1e\+308: set it from"),
        ((64, 32), {"begin": 1e308}, r"`begin`.*set it from 0 to"),
        ((64, 32), {"begin": 5}, r"`frames\[0\].begin`.* 5 s, behind the end of the film .* at 1 s"),
        ((64, 32), {"seconds": 1e308}, r"`seconds`.*set it from 0.001"),
        ((64, 32), {"w": 1e308}, r"`w`.* 1e\+308: set it from 1 to 32768 pixels"),
        (
            (4096, 2),
            {"h": None, "w": None, "fl_x": None, "camera_angle_x": 1},
            "4096 x 2 pixels, and an object needs 16",
        ),
    ],
)
def test_fields_of_a_film_are_named(tmp_path, size, fields, words):
    _film(tmp_path, size, 30, **fields)
    with value_error(words):
        read_videos(tmp_path)


@pytest.mark.parametrize(("begin", "rate"), [(0.0, None), (1.0, None), (0.0, 10.0)])
def test_a_film_with_a_variable_frame_rate(tmp_path, begin, rate):
    """A frame is seen at its time, until the next one; ``fps`` spreads the same frames over another time."""
    path = _film(tmp_path, (64, 64), 3, **({"begin": begin} if begin else {}), **({"fps": rate} if rate else {}))
    _variable(path)
    (film,) = read_videos(tmp_path)
    shown = (film.images[:, 32, 32, 1].double() * 219 / 255 + 16 - 20) / 60 - begin
    slower = 1.0 if rate is None else 65 / 2.95 / rate  # 65 frames in 2.95 s
    assert film.times[-1] / slower == pytest.approx(2.95 - begin, abs=0.1)
    late = double(film.times) / slower - shown
    assert -0.05 < late.min() < late.max() < 0.1


@pytest.mark.parametrize("rate", ["5", "24", "25", "24000/1001", "30000/1001", "100/3", "240"])
def test_a_constant_frame_rate_changes_no_frame(tmp_path, rate):
    path = tmp_path / "film.mkv"
    words = ["-y", "-v", "error", "-f", "lavfi", "-i", f"testsrc=s=64x32:r={rate}:d=10", "-c:v", "libx264", "-bf", "2"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words, "-pix_fmt", "yuv420p", str(path)], check=True)
    for part in ([], ["-ss", "1.013", "-t", "2.5"]):
        head, *frames = videos.frames_of(path, part)
        assert [frame.tobytes() for frame in frames] == list(imageio_ffmpeg.read_frames(path, input_params=part))[1:]
        assert head["fps"] == pytest.approx(float(Fraction(rate)), rel=1e-12 if rate != "100/3" else 2e-4)


def test_frames_that_are_too_large(tmp_path, monkeypatch, decoded):
    """ffmpeg refuses to decode them; those of another size than their camera's go no further than the header."""
    huge = _film(tmp_path, (64, 64), 3)
    read_videos(tmp_path)
    decoded.clear()
    with monkeypatch.context() as smaller:
        smaller.setattr(videos, "MOST_PIXELS", 64 * 64 - 1)
        with value_error(r"film0.mp4 has more than 4,095 pixels: make it smaller\.$"):
            read_videos(tmp_path)
    assert decoded == {}
    huge.unlink()
    (tmp_path / "transforms.json").unlink()
    _film(tmp_path, (64, 64), 30, says=(64, 32))
    with value_error("is not 64 x 32"):
        read_videos(tmp_path)
    assert decoded == {"film0.mp4": 0}


def test_a_camera_that_is_not_wanted_is_not_decoded(tmp_path, decoded):
    _film(tmp_path, (64, 64), 30, camera="left", time=1.0)
    _film(tmp_path, (64, 64), 30, camera="right", time=0.5)
    (film,) = read_videos(tmp_path, ["left"])
    assert decoded == {"film0.mp4": film.images.numel()}
    assert film.times[0] == 0.5  # the clock of all cameras begins with the earliest frame


@pytest.mark.parametrize("name", ["rig/left", "..\\left", "../../left"])
def test_a_camera_name_that_is_a_path(own, tmp_path, name):
    """Files of results are named after cameras."""
    _film(tmp_path, (64, 64), 3, camera=name)
    with value_error(r"`frames\[0\].camera` .* without /"):
        read_videos(tmp_path)
    given = json.loads((own / "video/transforms.json").read_text())
    given["frames"][0]["camera"] = name
    shutil.copytree(own / "video", tmp_path / "video")
    (tmp_path / "video/transforms.json").write_text(json.dumps(given))
    with value_error(r"`frames\[0\].camera` .* without /"):
        read_videos(tmp_path / "video")


def test_the_frame_at_a_time():
    """To two microseconds, as cameras write their times in decimals."""
    third = 1 / 3
    seen = videos.Footage("a", (0.0, third, 2 * third), (), torch.zeros(3, 1, 1, 3, dtype=torch.uint8))
    assert [seen.frame_at(time) for time in (0.0, 0.333333, 0.333334, 0.666667)] == [0, 1, 1, 2]
    assert [seen.frame_at(time) for time in (-0.1, 0.33333, 0.33334, 0.5, 0.7)] == [None] * 5
