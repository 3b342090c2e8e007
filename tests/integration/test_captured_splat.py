"""A captured splat through the whole pipeline; give its path in GS_TEST_SPLAT (y down, about 4.4 units high)."""

import os
from pathlib import Path

import pytest
import torch

from gaussian_swaying.simulation.config import build_parser, build_pipeline

SPLAT = os.environ.get("GS_TEST_SPLAT")
CONFIG = Path(__file__).resolve().parents[2] / "configs" / "sim" / "hanging_object.yaml"
pytestmark = pytest.mark.skipif(SPLAT is None, reason="GS_TEST_SPLAT names no captured splat")


def test_first_picture_is_the_splat_and_the_object_stays_whole():
    parser = build_parser()
    pipeline, _ = build_pipeline(parser, parser.parse_args(["--config", str(CONFIG), "--scene.ply", str(SPLAT)]))
    with torch.inference_mode():
        state = pipeline.start()
        moved = pipeline.render(state, 0).color
        rest, camera = pipeline.scene.rest(), pipeline.camera_at(0)
        pipeline.shader = None
        plain = pipeline.draw(rest, pipeline.colors(rest, camera), camera).color
        assert float((moved - plain).square().mean()) <= 10**-3.5  # 35 dB
        for _ in range(3):
            state, health = pipeline.advance(state)
    assert health.lost == 0
    assert health.stretch_min > 0.5
    assert health.stretch_max < 2
    assert health.displacement_mean > 0.005
