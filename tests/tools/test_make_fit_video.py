"""``tools/datasets/make_fit_video.py``: what it writes can be read by a fit."""

import pytest

from gaussian_swaying.inverse.videos import read_videos

from .conftest import ROOT, tool_of


def test_the_shipped_flag_makes_a_video(tmp_path):
    tool = tool_of("datasets/make_fit_video.py")
    config = str(ROOT / "configs/sim/printed_flag.yaml")
    assert tool.main(["--config", config, "--output", str(tmp_path / "video"), "--frames", "3", "--device", "cpu"]) == 0
    left, right = read_videos(tmp_path / "video")
    assert (left.name, right.name) == ("left", "right")
    assert left.times == pytest.approx([0.0, 1 / 24, 2 / 24], abs=1e-6)
    assert left.images.float().std() > 10
    noise = left.images[0, :8, :8].float()
    assert 0 < noise.std() < 5
