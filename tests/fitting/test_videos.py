"""Videos with cameras: what is read, and the sentence for what cannot be."""

import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from gaussian_swaying.fitting.videos import frame_times, read_videos

from .conftest import FRAMES, cameras


def test_two_cameras(own):
    left, right = read_videos(own / "video")
    assert (left.name, right.name) == ("left", "right")
    assert left.images.shape == (FRAMES, 120, 200, 3)
    assert left.masks.shape == (FRAMES, 120, 200)
    assert left.size == (200, 120)
    assert frame_times([left, right]) == pytest.approx([k / 24 for k in range(FRAMES)], abs=1e-6)
    wanted = cameras()["left"]
    assert torch.allclose(left.cameras[0].world_to_camera, wanted.world_to_camera, atol=1e-5)
    assert torch.allclose(left.cameras[0].intrinsics, wanted.intrinsics, atol=1e-4)


def test_a_video_file(own, tmp_path):
    given = json.loads((own / "video/transforms.json").read_text())
    entry = {name: value for name, value in given["frames"][0].items() if name not in ("file_path", "mask_path")}
    pictures = np.stack([iio.imread(own / f"video/left_{k:04d}.png") for k in range(FRAMES)])
    iio.imwrite(tmp_path / "left.mp4", np.pad(pictures, ((0, 0), (0, 8), (0, 8), (0, 0))), fps=24)
    entry |= {"video_path": "left.mp4", "w": 208, "h": 128, "time": 2.0}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [entry]}))
    (film,) = read_videos(tmp_path)
    assert film.times == pytest.approx([k / 24 for k in range(FRAMES)], abs=1e-4)
    assert film.images.shape == (FRAMES, 128, 208, 3)
    assert float((film.images[3, :120, :200].float() - pictures[3].astype("f4")).abs().mean()) < 6


def test_bad_videos(own, tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_videos(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"no transforms.json"):
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
        with pytest.raises(ValueError, match=words):
            read_videos(tmp_path / "video")
