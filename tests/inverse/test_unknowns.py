"""Unknowns: ranges, the polar form of the flow, and how values get into a variant."""

import pytest
import torch
from shared import value_error
from small_films import changed

from gaussian_swaying.inverse.unknowns import Unknown, check_unknowns
from gaussian_swaying.simulation.model import flow_of


@pytest.mark.parametrize("scale", ["log", "linear"])
def test_value_and_share_are_inverse(scale):
    unknown = Unknown("material.E", 1e3, 1e5, scale)
    for share in (0.0, 0.3, 1.0):
        assert unknown.share(unknown.value(share)) == pytest.approx(share)
        step = 1e-6
        slope = (unknown.value(share + step) - unknown.value(share - step)) / (2 * step)
        assert unknown.slope(share) == pytest.approx(slope, rel=1e-6)


def test_flow_in_polar_form():
    flow = flow_of([0.0, 0.0, 1.0], {"wind.speed": 2.0, "wind.azimuth": 30.0, "wind.elevation": 30.0})
    assert flow == pytest.approx([1.5, 0.75**0.5, 1.0])
    assert flow_of([3.0, 4.0, 0.0], {"wind.speed": 10.0}) == pytest.approx([6.0, 8.0, 0.0])


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


def test_a_variant_is_the_simulation_with_these_values(simulation, tmp_path):
    values = {"material.E": 2e4, "material.nu": 0.2, "material.density": 40.0, "material.thickness": 0.02}
    found = simulation.model.at(values).points
    wanted = changed(tmp_path, material={name.split(".")[1]: value for name, value in values.items()}).scene.points
    for name in ("position", "mass", "volume", "youngs_modulus", "poisson_ratio"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name))


def test_what_has_no_place_is_refused(simulation, tmp_path):
    with value_error("There is no"):
        check_unknowns(simulation, [Unknown("wind.modulations.0.amplitude", 0.0, 1.0)])
    with value_error("twice"):
        check_unknowns(simulation, [Unknown("wind.speed", 1.0, 2.0)] * 2)
    still = changed(tmp_path, wind={"flow": [0.0, 0.0, 0.0]})
    with value_error(r"no `wind.flow`"):
        check_unknowns(still, [Unknown("wind.azimuth", 0.0, 90.0)])


def test_a_modulation(tmp_path):
    wind = {"flow": [4.0, 0.0, 0.0], "modulations": [{"class_path": "SineSway", "init_args": {"period": 1.0}}]}
    simulation = changed(tmp_path, wind=wind)
    found = simulation.model.at({"wind.modulations.0.amplitude": 0.25, "wind.speed": 8.0}).wind
    assert found(0.25).tolist() == pytest.approx([10.0, 0.0, 0.0])
    assert simulation.wind(0.25).tolist() == pytest.approx([6.0, 0.0, 0.0])
