"""``bench.py live``: what it shows of what was recorded."""

import io

import numpy as np
import pytest
import torch
from bench.cases import live
from PIL import Image

from gaussian_swaying.geometry.rotations import quat_to_rotation

from .conftest import HEAD, cells


def test_the_table_names_the_goal_and_the_size_of_the_picture():
    row = {"name": "guitar", "gaussians": 90_854, "points": 1_815, "window": [640, 360], "pictures_per_s": 5.87}
    row |= {"picture": "170x96", "picture_bytes": 1498.0, "real_time": 0.067, "step_s": 0.0025, "latency_ms": 382.0}
    for device, wanted in (("x86_64 CPU", "5"), ("NVIDIA H200", "-")):
        (told,) = cells("live.rates", HEAD | {"device": device, "rows": [row]})
        assert told[3:7] == ["640x360", "170x96", "5.9", wanted]


def test_the_table_of_states_names_both_grids():
    row = {"name": "flag", "gaussians": 3750, "points": 3550, "dx_m": 0.047, "configured_dx_m": 0.032}
    (told,) = cells("live.states", HEAD | {"rows": [row | {"states_per_s": 24.96, "states_real_time": 0.998}]})
    assert told == ["flag", "3,750", "3,550", "0.047", "0.032", "25.0", "1.00"]


def test_a_small_scene_is_watched(monkeypatch):
    """The client gets states and then pictures, on the grid that ``live`` chooses."""
    pytest.importorskip("viser", reason="needs the extra [viewer]")
    monkeypatch.setattr(live, "WARM", 1.0)
    monkeypatch.setattr(live, "CHANGES", 1)
    small = ["--config", str(live.ROOT / "configs" / "sim" / "flag.yaml"), "--scene.generator.init_args.spacing=0.05"]
    row = live.watch([*small, "--solver.dx=0.2"], "cpu", 2.0)
    assert row["states_per_s"] > 0
    assert row["pictures_per_s"] > 0
    assert row["dx_m"] == row["configured_dx_m"] == 0.2
    assert row["states_real_time"] > 0
    assert row["problem"] is None


def test_the_camera_of_the_client_looks_at_its_target():
    turn = live.camera_rotation([0.0, -3.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])
    rotation = quat_to_rotation(torch.tensor(turn, dtype=torch.float64))
    assert rotation[:, 2].tolist() == pytest.approx([0, 1, 0])  # forward
    assert rotation[:, 1].tolist() == pytest.approx([0, 0, -1])  # down


def test_pixels_of_a_received_picture():
    buffer = io.BytesIO()
    Image.fromarray(np.full((12, 20, 3), 200, dtype=np.uint8)).save(buffer, "jpeg")
    assert live.pixels_of(buffer.getvalue()).mean() == pytest.approx(200, abs=1)
