"""Crowns whose branches bend in the wind."""

import pytest
from bench.problems.crowns import branch_drag, crown, exponent, of_elasticas
from bench.problems.reconfiguration import elastica


def test_a_branch_across_the_wind_is_an_elastica():
    cauchy = [1.0, 10.0, 100.0]
    assert branch_drag(cauchy, 0.0) == pytest.approx([elastica(c, "projected")[0] for c in cauchy], rel=1e-5)


def test_a_stiff_branch_that_leans_has_the_drag_of_the_flow_across_it():
    for lean in (-0.6, 0.6):
        assert branch_drag([0.1], lean)[0] == pytest.approx(0.681179, rel=0.02)  # cos² 0.6


def test_the_exponent_of_a_power():
    assert exponent([10.0, 20.0, 30.0], [u**1.3 for u in (10.0, 20.0, 30.0)]) == pytest.approx(0.7)


def test_two_branches_bend_as_elasticas():
    """On a coarse grid, in two winds."""
    found = crown("birch", speeds=(10.0, 20.0), cells=5, branches=2, settle=6.0)
    assert found["R_20"] < found["R_10"] < 0.7
    assert abs(found["error"]) < 0.12
    assert found["exponent"] == pytest.approx(found["elastica"], abs=0.15)


def test_thick_branches_do_not_bend():
    thick, thin = (of_elasticas("birch", diameter, branches=1)["exponent"] for diameter in (0.1, 0.012))
    assert abs(thick) < 0.01 < 0.5 < thin
