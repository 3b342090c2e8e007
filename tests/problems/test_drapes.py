"""Cusick's test: a fabric over a disc."""

import math

import numpy as np
import pytest
from bench.problems.drapes import DISC, FABRIC, RingScene, around, bending_length, drape, of_shell, shadow


def test_the_shadow_of_a_level_fabric_is_all_and_that_of_the_disc_nothing():
    for radius, share in ((FABRIC, 1.0), (DISC, 0.0)):
        turn = 2 * math.pi * np.arange(2000) / 2000
        edge = radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
        assert shadow(edge) == pytest.approx(share, abs=1e-5)


@pytest.mark.parametrize("folds", [3, 4])
def test_an_edge_goes_around_once(folds):
    turn = np.linspace(0, math.pi / folds, 9)
    half = np.stack([np.cos(turn), np.sin(turn), np.cos(folds * turn)], axis=-1)
    edge = around(half, folds)
    angle = 2 * math.pi * np.arange(16 * folds) / (16 * folds)
    np.testing.assert_allclose(edge, np.stack([np.cos(angle), np.sin(angle), np.cos(folds * angle)], -1), atol=1e-12)


def test_the_ring_has_its_area_and_the_bending_length_is_peirces():
    scene = RingScene(spacing=0.005)
    cloud = scene.generate()
    assert len(cloud.means) == math.prod(scene.shape)
    assert float(cloud.means.norm(dim=1).max()) == pytest.approx(FABRIC - 0.0025, abs=1e-4)
    assert bending_length(0.2, 0.2 * 9.81 * 0.03**3) == pytest.approx(0.03)


@pytest.mark.parametrize(("layers", "folds"), [(3, 4), (1, 5)])
def test_a_fabric_drapes_as_the_shell(layers, folds):
    """On a coarse grid and not quite at rest; the errors on finer ones are on the page about nature."""
    found = drape("denim", folds=folds, cells=4, settle=5.0, layers=layers)
    assert found["weight"] == pytest.approx(1, abs=2e-3)
    assert found["folds_found"] == folds
    assert abs(found["error"]) < 0.2


def test_an_unknown_fabric_is_refused():
    for function in (drape, of_shell):
        with pytest.raises(ValueError, match="`fabric` to be one of interlock, rib, ponte, denim"):
            function("felt", folds=4)
