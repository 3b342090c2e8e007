"""The video encoder by itself; test_recorder.py has the videos of runs."""

import subprocess

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest

from gaussian_swaying.recording.video import encode_video


def _probe(path):
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)], capture_output=True, text=True)
    return next(line for line in done.stderr.splitlines() if "Video:" in line)


def test_video_frames_are_in_order_at_the_rate_asked_for(tmp_path):
    files = []
    for k in range(5):
        files.append(tmp_path / f"{k}.png")
        iio.imwrite(files[-1], np.full((16, 16, 3), 50 * k, dtype=np.uint8))
    encode_video(files, tmp_path / "out.mp4", 10.0)
    frames = iio.imread(tmp_path / "out.mp4")
    assert [round(float(frame.mean()) / 50) for frame in frames] == [0, 1, 2, 3, 4]
    assert "10 fps" in _probe(tmp_path / "out.mp4")


def test_frames_of_different_sizes_are_no_video(tmp_path):
    files = [tmp_path / "0.png", tmp_path / "1.png"]
    for file, width in zip(files, (16, 32), strict=True):
        iio.imwrite(file, np.zeros((16, width, 3), dtype=np.uint8))
    with pytest.raises(OSError, match=r"out\.mp4: a frame is 32 x 16, the first one is 16 x 16"):
        encode_video(files, tmp_path / "out.mp4", 10.0)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["0.png", "1.png"]
