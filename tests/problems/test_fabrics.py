"""A strip of a fabric that hangs over an edge, against the elastica."""

import pytest
from bench.problems.fabrics import hanging_strip


def test_a_strip_hangs_as_its_bending_stiffness_says():
    """On a coarse grid and with little stiffness against stretch; the errors on finer ones are on the page."""
    found = hanging_strip("ponte", cells=6, stretch=20.0, settle=6.0)
    assert 0.4 < found["span"] < 1.0
    assert abs(found["residual"]) < 0.02
    assert abs(found["error"]) < 0.06


def test_an_unknown_fabric_is_refused():
    with pytest.raises(ValueError, match="`fabric` to be one of interlock, rib, ponte, denim"):
        hanging_strip("felt")
