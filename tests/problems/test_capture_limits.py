"""The best that photos can tell, against simulated measurements."""

import math

import pytest
import torch
from bench.problems.capture_limits import surface_limits

from gaussian_swaying.rendering.cameras.camera import look_at_camera

UP = torch.tensor([0.0, 0.0, 1.0])
ORIGIN = torch.zeros(3)


def _cameras(count=12, size=400, distance=2.0):
    eyes = [
        (distance * math.sin(a) * math.cos(b), distance * math.sin(a) * math.sin(b), distance * math.cos(a))
        for a, b in ((0.2 + 0.7 * k / count, 2.4 * k) for k in range(count))
    ]
    return [look_at_camera(eye, (0, 0, 0), (0.0, 1.0, 0.01), 40.0, size, size, dtype=torch.float64) for eye in eyes]


def test_two_views_are_triangulation():
    """Two rays at +-a see a height as h tan(a) to each side: an error of e z / (f sqrt(2) tan a)."""
    angle = 0.3
    eyes = [(2 * math.sin(s * angle), 0.0, 2 * math.cos(angle)) for s in (-1, 1)]
    cameras = [look_at_camera(eye, (0, 0, 0), (0.0, 1.0, 0.0), 40.0, 400, 400, dtype=torch.float64) for eye in eyes]
    focal = float(cameras[0].intrinsics[0, 0])
    place = 0.05 * 2.0 / focal
    expected = place / (math.sqrt(2) * math.tan(angle))
    assert surface_limits(cameras, ORIGIN, UP, 0.4)["height_common"] == pytest.approx(expected, rel=1e-6)


def test_least_squares_on_simulated_windows_reach_the_bound():
    cameras, generator = _cameras(), torch.Generator().manual_seed(0)
    found = surface_limits(cameras, ORIGIN, UP, 0.2, pixel_error=0.1)
    rays = torch.stack([camera.position / camera.position.norm() for camera in cameras])
    slide = rays[:, :2] / rays[:, 2:]
    focal = float(cameras[0].intrinsics[0, 0])
    deviation = 0.1 * 2.0 / focal
    noise = deviation * torch.randn(20_000, len(cameras), 2, generator=generator, dtype=torch.float64)
    centred = slide - slide.mean(0)
    height = (noise * centred).sum((1, 2)) / centred.square().sum()
    assert float(height.std()) == pytest.approx(found["height_common"], rel=0.02)


def test_the_error_falls_with_size_pixels_and_views():
    usual = surface_limits(_cameras(), ORIGIN, UP, 0.4)
    wide = surface_limits(_cameras(), ORIGIN, UP, 0.8)
    assert wide["height"] == pytest.approx(usual["height"] / 2)
    assert wide["tilt_deg"] == pytest.approx(usual["tilt_deg"] / 4)
    fine = surface_limits(_cameras(size=800), ORIGIN, UP, 0.4)
    assert fine["height"] == pytest.approx(usual["height"] / 4)
    assert fine["height_common"] == pytest.approx(usual["height_common"] / 2)
    assert surface_limits(_cameras(48), ORIGIN, UP, 0.4)["height"] == pytest.approx(usual["height"] / 2, rel=0.1)
    assert usual["views"] == 12


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="cameras"):
        surface_limits(_cameras(), ORIGIN, -UP, 0.4)
    with pytest.raises(ValueError, match="size"):
        surface_limits(_cameras(), ORIGIN, UP, 0.0)
