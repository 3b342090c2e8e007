"""``tools/make_fit_video.py``: what it writes can be read by a fit."""

import importlib.util
from pathlib import Path

import pytest

from gaussian_swaying.fitting.videos import read_videos

ROOT = Path(__file__).parents[2]


def test_the_shipped_flag_makes_a_video(tmp_path):
    spec = importlib.util.spec_from_file_location("make_fit_video", ROOT / "tools/make_fit_video.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    config = str(ROOT / "configs/sim/printed_flag.yaml")
    assert tool.main(["--config", config, "--output", str(tmp_path / "video"), "--frames", "3", "--device", "cpu"]) == 0
    left, right = read_videos(tmp_path / "video")
    assert (left.name, right.name) == ("left", "right")
    assert left.times == pytest.approx([0.0, 1 / 24, 2 / 24], abs=1e-6)
    assert left.images.float().std() > 10
    noise = left.images[0, :8, :8].float()
    assert 0 < float(noise.std()) < 5
