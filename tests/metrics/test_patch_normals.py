"""Tilts of patches, on sheets whose tilt is known."""

import math

import pytest
import torch

from gaussian_swaying.metrics.patch_normals import patch_normal_error


def _sheet(count=40_000):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([1.2, 0.8, 0.0])
    return points, torch.tensor([0.0, 0.0, 1.0]).repeat(count, 1), generator


def test_a_uniform_tilt_is_found_whatever_the_signs_and_the_size():
    points, up, generator = _sheet()
    tilt = math.radians(0.3)
    tilted = torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)]).repeat(len(points), 1)
    signs = torch.where(torch.rand(len(points), 1, generator=generator) < 0.5, -1.0, 1.0)
    for size in (0.1, 0.2, 0.4):
        assert patch_normal_error(points, signs * tilted, up, size) == pytest.approx(0.3, rel=1e-4)


def test_noise_is_averaged_out_and_waves_longer_than_a_patch_are_not():
    """Noise of 5 degrees falls with the root of the number of points; a wave of slope s leaves s sinc(pi L / wave)."""
    points, up, generator = _sheet()
    noise = math.radians(5.0) * torch.randn(len(points), 2, generator=generator)
    noisy = torch.nn.functional.normalize(up + torch.nn.functional.pad(noise, (0, 1)), dim=-1)
    small, large = (patch_normal_error(points, noisy, up, size) for size in (0.1, 0.4))
    expected = 5.0 * math.sqrt(2.0)  # of one point
    assert small == pytest.approx(expected / math.sqrt(40_000 / 0.96 * 0.01), rel=0.15)
    assert large < 0.5 * small
    slope, wave = math.radians(1.0), 0.6
    along = slope * torch.sin(2 * math.pi * points[:, 0] / wave)
    waved = torch.nn.functional.normalize(up + along[:, None] * torch.tensor([1.0, 0.0, 0.0]), dim=-1)
    for size in (0.1, 0.2):
        part = math.pi * size / wave
        assert patch_normal_error(points, waved, up, size) == pytest.approx(
            math.sqrt(0.5) * math.sin(part) / part, rel=0.05
        )


def test_weights_count():
    points, up, _ = _sheet(1000)
    tilted = torch.tensor([math.sin(0.1), 0.0, math.cos(0.1)]).repeat(1000, 1)
    left = points[:, 0] < 0.6
    normals = torch.where(left[:, None], up, tilted)
    assert patch_normal_error(points, normals, up, 0.05, left.float()) == pytest.approx(0.0, abs=1e-6)


def test_bad_input_is_named():
    points, up, _ = _sheet(4)
    with pytest.raises(ValueError, match="points"):
        patch_normal_error(points[:0], up[:0], up[:0], 0.1)
    with pytest.raises(ValueError, match="true_normals"):
        patch_normal_error(points, up, up[:2], 0.1)
    with pytest.raises(ValueError, match="size"):
        patch_normal_error(points, up, up, 0.0)
    with pytest.raises(ValueError, match="`weights` of shape"):
        patch_normal_error(points, up, up, 0.1, torch.ones(3))
    with pytest.raises(ValueError, match="all are zero"):
        patch_normal_error(points, up, up, 0.1, torch.zeros(4))
