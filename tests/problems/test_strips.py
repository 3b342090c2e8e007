"""A strip on hinges sags by its closed form; one that is clamped sags by a fifth of it."""

import pytest
from bench.problems.settings import Settings
from bench.problems.strips import hinged_strip


@pytest.mark.slow(twin="test_a_hinge_turns_where_a_clamp_does_not")
@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_a_hinge_takes_no_moment(shift):
    """Wherever the strip lies on the grid, with its middle plane on nodes or between them."""
    run = hinged_strip(16, Settings(), shift=shift)
    assert run["residual"] < 1e-3
    assert run["error"] < 0.005
    assert run["slope"] == pytest.approx(1, abs=0.01)
    assert run["moment"] < 0.05


def test_a_hinge_turns_where_a_clamp_does_not():
    """The same with four cells, which is coarse, beside the clamps below."""
    run = hinged_strip(4, Settings(), shift=0.3)
    assert run["residual"] < 1e-3
    assert run["error"] < 0.15
    assert run["slope"] == pytest.approx(1, abs=0.05)
    assert run["moment"] < 0.5


@pytest.mark.slow(gate=["clamp"])
@pytest.mark.parametrize("hold", ["clamp", "nodes"])
def test_what_holds_the_slope_fails_by_far(hold):
    run = hinged_strip(4, Settings(), hold=hold)
    assert run["error"] > 0.75
    assert run["slope"] < 0.1
    assert run["moment"] > 0.5


@pytest.mark.parametrize(("hold", "sag"), [("hinge", 1.0), ("clamp", 0.2)])
def test_one_layer_bends_by_itself(hold, sag):
    """Off the nodes, with twice the cells of the coarse strip above, and a strip that is thicker than a cell."""
    run = hinged_strip(8, Settings(), hold=hold, shift=0.3, layers=1)
    assert run["residual"] < 1e-3
    assert abs(1 - run["error"] if hold == "clamp" else 1 + run["error"]) == pytest.approx(sag, abs=0.02)
    thick = hinged_strip(8, Settings(), hold=hold, shift=0.3, layers=1, slenderness=6, sag=0.001)
    assert thick["error"] == pytest.approx(run["error"], abs=0.005)
