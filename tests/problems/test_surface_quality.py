"""The measures of trained Gaussians, on Gaussians placed by hand."""

import math

import pytest
import torch
from bench.problems.surface_quality import surface_quality
from small_scenes import plain_cloud

from gaussian_swaying.captures.generated_capture import GeneratedCapture
from gaussian_swaying.gaussians.model import GaussianSurfaceModel


def _model(tilt=0.0, lift=0.0, ratio=1.0, sigma=0.006, opacities=None):
    """Discs on a 0.02 m lattice over the flat flag y = 0, tilted about x and lifted along y."""
    x = torch.arange(0.01, 1.2, 0.02)
    z = torch.arange(0.01, 0.8, 0.02)
    gx, gz = (grid.reshape(-1) for grid in torch.meshgrid(x, z, indexing="ij"))
    count = len(gx)
    half = 0.5 * (0.5 * math.pi + tilt)  # a quarter turn about x takes the disc's z to the flag's y
    means, quats = torch.stack([gx, torch.full((count,), lift), gz], -1), [math.cos(half), math.sin(half), 0.0, 0.0]
    scales = torch.tensor([ratio * sigma, sigma, 0.1 * sigma]).log()
    return GaussianSurfaceModel.from_cloud(
        plain_cloud(means, scales, quats, 3.0 if opacities is None else opacities(count))
    )


@pytest.fixture(scope="module")
def flat():
    return GeneratedCapture(ripple=0.0)


def test_discs_on_the_sheet(flat):
    found = surface_quality(_model(), flat)
    assert found["gaussians"] == found["simulated"] == 60 * 40
    assert found["round_share"] == found["small_share"] == found["near_share"] == found["decided_share"] == 1.0
    assert found["flatness_median"] == pytest.approx(0.1, rel=1e-5)
    assert found["angle_median_deg"] < 0.05  # float32 at a cosine of 1
    assert found["distance_p90_m"] < 1e-7
    assert found["area_paper_ratio"] == pytest.approx(2400 * math.pi * 0.006**2 / 0.96, rel=1e-5)


def test_tilt_distance_shape_and_opacity_are_told_apart(flat):
    tilted = surface_quality(_model(tilt=math.radians(12.0), lift=0.03), flat)
    assert tilted["angle_median_deg"] == pytest.approx(12.0, abs=1e-3)
    assert tilted["angle_p90_deg"] == pytest.approx(12.0, abs=1e-3)
    for size in (10, 20, 40):
        assert tilted[f"tilt_{size}cm_deg"] == pytest.approx(12.0, abs=1e-3)
    assert tilted["distance_median_m"] == pytest.approx(0.03, rel=1e-5)
    assert surface_quality(_model(lift=0.06), flat)["near_share"] == 0.0
    long = surface_quality(_model(ratio=1.2), flat)
    assert (long["round_share"], long["small_share"]) == (0.0, 1.0)
    assert surface_quality(_model(ratio=1.4), flat)["small_share"] == 0.0
    some = surface_quality(_model(opacities=lambda n: torch.arange(n).remainder(4).float().sub(2).mul(2)), flat)
    # sigmoid of -4, -2, 0 and 2 in turn: 0.018, 0.12, 0.5, 0.88
    assert some["decided_share"] == 0.25
    assert some["simulated"] == 1800
