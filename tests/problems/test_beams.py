"""The sagging cantilever against the elastica, shear and quadrature included."""

import math

import pytest
from bench.problems.beams import cantilever, elastica
from bench.problems.settings import Settings


# solved as a boundary value problem by other means
@pytest.mark.parametrize(
    ("b", "drop", "shortening", "slope"),
    [
        (0.5, 0.0623, 0.0022, 4.76),
        (1, 0.1235, 0.0088, 9.46),
        (2, 0.2385, 0.0331, 18.43),
        (4, 0.4252, 0.1099, 33.72),
        (8, 0.6406, 0.2756, 53.87),
        (16, 0.7970, 0.4900, 72.21),
        (32, 0.8785, 0.6715, 83.73),
    ],
)
def test_elastica_against_a_table(b, drop, shortening, slope):
    found = elastica(b)
    assert found[:2] == pytest.approx((drop, shortening), abs=6e-5)
    assert math.degrees(found[2]) == pytest.approx(slope, abs=0.01)


def test_elastica_tends_to_the_linear_beam():
    """w L⁴ / (8 E I), with a correction of second order in the load."""
    assert elastica(1e-3)[0] == pytest.approx(1e-3 / 8, rel=1e-6)
    assert elastica(1.0, steps=100)[0] == pytest.approx(elastica(1.0, steps=800)[0], rel=1e-8)


@pytest.mark.parametrize("slenderness", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_cantilever_sags_as_the_elastica(slenderness):
    """Two and three cells: the whole error is that of shear and of the points' second moment of area, to 0.5 %."""
    runs = [cantilever(cells, Settings(), slenderness=slenderness, settle=9.0) for cells in (2, 3)]
    assert runs[1]["error"] < runs[0]["error"]
    for run in runs:
        assert run["residual"] < 1e-3
        assert abs(run["unexplained"]) < 0.005
        assert run["error"] < run["shear"] + run["quadrature"] + 0.005
    # 1 / (1 - 1 / m²) with m layers
    assert runs[0]["quadrature"] == pytest.approx(1 / 15, rel=0.05)
    assert runs[1]["quadrature"] == pytest.approx(1 / 35, rel=0.05)


@pytest.mark.parametrize("slenderness", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_a_single_cell_needs_three_layers(slenderness):
    """Two layers in one cell bend without strain (see `cantilever`), three carry the weight."""
    loose = cantilever(1, Settings(), slenderness=slenderness, settle=9.0)
    firm = cantilever(1, Settings(), slenderness=slenderness, settle=9.0, per_cell=3)
    assert loose["error"] > 1.0
    assert abs(firm["unexplained"]) < 1.8 / slenderness**2
