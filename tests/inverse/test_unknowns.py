"""Unknowns: ranges, the polar form of the flow, and how values get into a variant."""

import pytest
from shared import value_error
from small_films import changed

from gaussian_swaying.inverse.unknowns import Unknown, check_unknowns


@pytest.mark.parametrize("scale", ["log", "linear"])
def test_value_and_share_are_inverse(scale):
    unknown = Unknown("material.E", 1e3, 1e5, scale)
    for share in (0.0, 0.3, 1.0):
        assert unknown.share(unknown.value(share)) == pytest.approx(share)
        step = 1e-6
        slope = (unknown.value(share + step) - unknown.value(share - step)) / (2 * step)
        assert unknown.slope(share) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "low", "high", "words"),
    [
        ("material.stiffness", 1, 2, "cannot be sought"),
        ("material.E", 2, 1, "[low, high]"),
        ("material.E", 0, 1, "from 0.001"),
        ("aero.C_D", -1, 1, "from 0 to"),
        ("material.nu", 0.1, 0.6, "range"),
    ],
)
def test_bad_ranges(name, low, high, words):
    with value_error(r".") as error:
        Unknown(name, low, high)
    assert words in str(error.value)
    assert name in str(error.value)


def test_what_has_no_place_is_refused(simulation, tmp_path):
    with value_error("There is no"):
        check_unknowns(simulation, [Unknown("wind.modulations.0.amplitude", 0.0, 1.0)])
    with value_error("twice"):
        check_unknowns(simulation, [Unknown("wind.speed", 1.0, 2.0)] * 2)
    still = changed(tmp_path, wind={"flow": [0.0, 0.0, 0.0]})
    with value_error(r"no `wind.flow`"):
        check_unknowns(still, [Unknown("wind.azimuth", 0.0, 90.0)])
