"""A plate that bends in a steady flow, against the elastica."""

import pytest
from bench.problems.reconfiguration import POWERS, elastica, reconfiguration

KNOWN = {
    "projected": (0.9827, 0.9371, 0.7493, 0.5320, 0.3596, 0.2377, 0.1869, 0.0872),
    "cross_flow": (0.9748, 0.9141, 0.7147, 0.5236, 0.3721, 0.2484, 0.1918, 0.0890),
}
"""R at C = 1, 2, 5, 10, 20, 50, 100, 1000, computed apart from this code."""
CAUCHY = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0)


@pytest.mark.parametrize("law", POWERS)
def test_the_drag_of_the_elastica(law):
    assert [elastica(c, law)[0] for c in CAUCHY] == pytest.approx(KNOWN[law], abs=6e-5)
    tips = [elastica(c, "projected")[1] for c in (1.0, 10.0, 100.0)]
    assert tips == pytest.approx([0.1229, 0.6464, 0.8728], abs=6e-5)


@pytest.mark.parametrize("law", POWERS)
def test_a_stiff_plate_has_the_whole_drag_and_a_limp_one_follows_the_law_of_vogel(law):
    """R falls as C^(-1/3), which is a drag that grows as U^(2 - 2/3)."""
    assert elastica(1e-4, law)[0] == pytest.approx(1.0, abs=1e-6)
    assert elastica(1000.0, law)[0] / elastica(100.0, law)[0] == pytest.approx(10 ** (-1 / 3), rel=0.01)


@pytest.mark.parametrize("law", POWERS)
def test_a_plate_bends_with_the_flow(law):
    """On a coarse grid; the errors at 16 and 32 cells are on the page of the validation."""
    found = reconfiguration(3.0, law, cells=8, slenderness=30.0, settle=10.0)
    assert abs(found["drift"]) < 5e-3
    assert found["drag"] < 0.9  # it has bent
    assert abs(found["error"]) < 0.05
    assert abs(found["tip"] - found["exact_tip"]) < 0.05


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="`law` to be one of projected, cross_flow"):
        elastica(1.0, "paper")
    with pytest.raises(ValueError, match="`cauchy`"):
        elastica(0.0, "projected")
    with pytest.raises(ValueError, match="`slenderness` of at least `cells`"):
        reconfiguration(1.0, "projected", cells=16, slenderness=12.0)
