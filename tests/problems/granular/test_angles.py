"""Sand: which angles the Drucker-Prager law mobilises."""

import pytest
from bench.problems.granular.angles import plane_strain_angle, shear_angle, triaxial_angle

from gaussian_swaying.mpm.laws.sand import Sand


@pytest.mark.parametrize(("friction", "slope"), [(20.0, 24.0), (30.0, 34.6), (40.0, 43.4)])
def test_angle_in_simple_shear(friction, slope):
    assert shear_angle(Sand(friction)) == pytest.approx(slope, abs=0.5)


@pytest.mark.parametrize("correction", [False, True])
def test_cone_is_fitted_in_triaxial_compression(correction):
    assert triaxial_angle(Sand(30.0, correction)) == pytest.approx(30.0, abs=0.1)


def test_plane_strain_mobilises_more():
    assert plane_strain_angle(Sand(30.0)) == pytest.approx(43.85, abs=0.1)
