"""The soft post in wind: pressure on its skin, its mesh, print and configurations; Newton is tried where it is."""

import math
import sys

import numpy as np
import pytest
import yaml

from gaussian_swaying import Simulation
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.inverse.plan import read_plan

from .conftest import beside

TOOL = "make_fit_data"
soft = beside("soft_case")
newton = beside("newton_soft")


def _plate(angle):
    """A plate of 0.3 m x 0.2 m as two triangles, its normal turned from x towards y."""
    corners = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.3, 0.2], [0.0, 0.0, 0.2]])
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return corners @ turn.T, np.array([c, s, 0.0])


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
@pytest.mark.parametrize("order", [[[0, 1, 2], [0, 2, 3]], [[0, 2, 1], [3, 2, 0]]], ids=["one side", "both sides"])
def test_the_pressure_on_a_plate_is_that_of_the_closed_form(newton, angle, order):
    """f = rho C A |U| (U n) n / 2, whichever way the triangles face; a third of each at its corners."""
    positions, normal = _plate(angle)
    air = newton.Air((3.0, 4.0, 0.0), density=1.2, drag=0.8)
    forces = newton.skin_forces(positions, np.zeros((4, 3)), np.array(order), air)
    expected = 0.5 * 1.2 * 0.8 * 0.06 * 5.0 * (np.array([3.0, 4.0, 0.0]) @ normal) * normal
    np.testing.assert_allclose(forces.sum(0), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(forces[0], expected / 3, rtol=1e-12, atol=1e-15)  # two halves: a third of each
    np.testing.assert_allclose(forces[1], expected / 6, rtol=1e-12, atol=1e-15)


def test_newtons_moduli_give_the_stress_of_hooke_at_small_strain(newton):
    """The stress as Newton's kernel computes it, by hand, for a small strain without symmetry."""
    young, nu = 3e4, 0.3
    k_mu, k_lambda = newton.newton_moduli(young, nu)
    draw = np.random.default_rng(1)
    strain = 1e-6 * draw.normal(size=(3, 3))
    F = np.eye(3) + strain
    cofactor = np.linalg.det(F) * np.linalg.inv(F).T
    alpha = 1 + 0.75 * k_mu / k_lambda
    stress = k_mu * (1 - 1 / ((F * F).sum() + 1)) * F + k_lambda * (np.linalg.det(F) - alpha) * cofactor
    small = 0.5 * (strain + strain.T)
    mu, lam = young / (2 * (1 + nu)), young * nu / ((1 + nu) * (1 - 2 * nu))
    np.testing.assert_allclose(stress, 2 * mu * small + lam * np.trace(small) * np.eye(3), atol=2e-4 * 2 * mu * 1e-6)


def test_places_follow_the_vertices(soft):
    pattern = soft.SoftPattern(cells=2)
    rest = pattern.block.vertices()
    turned = rest @ np.array([[1.0, 0.2, 0.0], [0.0, 1.1, 0.3], [0.1, 0.0, 0.9]]) + [0.1, 0.0, 0.2]
    draw = np.random.default_rng(0)
    places = draw.uniform([-0.03, -0.03, 0.0], [0.03, 0.03, 0.3], (50, 3))
    found = soft.moved_places(pattern, np.stack([rest, turned]), places)
    np.testing.assert_allclose(found[0], places, atol=1e-12)
    expected = places @ np.array([[1.0, 0.2, 0.0], [0.0, 1.1, 0.3], [0.1, 0.0, 0.9]]) + [0.1, 0.0, 0.2]
    np.testing.assert_allclose(found[1], expected, atol=1e-12)


def test_the_scene_and_the_fit_can_be_read_and_start_wrong(soft, tool, tmp_path):
    cases = sys.modules["fit_cases"]
    pattern, folder = soft.SoftPattern(), tmp_path.as_posix()
    write_ply(tmp_path / "rest.ply", soft.splat(pattern, 0.006))
    settings = soft.scene_settings(pattern, cases.FitVideo(), folder)
    settings["solver"]["dx"], settings["scene"]["filling"] = 0.03, {"spacing": 0.01}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(settings))
    (tmp_path / "fit.yaml").write_text(yaml.safe_dump(cases.fit_settings(folder) | {"unknowns": soft.SOUGHT}))
    simulation = Simulation.from_yaml(tmp_path / "scene.yaml", camera=None, device="cpu")
    assert simulation.frames_wanted == pattern.frames
    assert float(simulation.scene.points.mass.sum()) == pytest.approx(60.0 * 0.06**2 * 0.3, rel=0.05)
    truth = soft.truth_fields(pattern, cases.FitVideo())
    plan = read_plan(tmp_path / "fit.yaml")
    true = {"wind.speed": truth["speed"], "wind.azimuth": truth["azimuth"], "material.E": truth["E"]}
    assert {unknown.name for unknown in plan.unknowns} == set(true)
    for unknown in plan.unknowns:
        assert unknown.low < true[unknown.name] < unknown.high
    assert settings["material"]["E"] < 0.7 * truth["E"]
    assert np.linalg.norm(np.subtract(settings["wind"]["flow"], truth["flow"])) > 0.3 * truth["speed"]
