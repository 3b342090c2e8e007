"""A captured splat through the whole simulation; give its path in GS_TEST_SPLAT (y down, about 4.4 units high)."""

import os
from pathlib import Path

import pytest
import torch

from gaussian_swaying.simulation.simulation import Simulation

SPLAT = os.environ.get("GS_TEST_SPLAT")
CONFIG = Path(__file__).resolve().parents[2] / "configs" / "sim" / "hanging_object.yaml"
pytestmark = pytest.mark.skipif(SPLAT is None, reason="GS_TEST_SPLAT names no captured splat")


def test_first_picture_is_the_splat_and_the_object_stays_whole():
    parser = Simulation.parser()
    simulation = Simulation.from_settings(
        parser, parser.parse_args(["--config", str(CONFIG), "--scene.ply", str(SPLAT)])
    )
    with torch.inference_mode():
        state = simulation.start()
        moved = simulation.painter.render(state, 0).color
        rest, camera = simulation.scene.rest(), simulation.painter.camera_at(0)
        simulation.painter.shader = None
        plain = simulation.painter.draw(rest, simulation.painter.colors(rest, camera), camera).color
        assert float((moved - plain).square().mean()) <= 10**-3.5  # 35 dB
        for _ in range(3):
            state, health = simulation.advance(state)
    assert health.lost == 0
    assert health.stretch_min > 0.5
    assert health.stretch_max < 2
    assert health.displacement_mean > 0.005
