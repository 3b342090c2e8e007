"""A stretched sheet that wrinkles: the shell it is compared with, how a wave is measured, and a small case.

Covers: .
"""

import math

import numpy as np
import pytest
from bench.problems.shells import settle
from bench.problems.wrinkles import WIDTH, Quarter, Strip, shell, wavelength, wrinkles


def test_the_formula_is_that_of_the_paper():
    """There it also stands for the thickness h: the square root of 2 pi L h, over (3 (1 - nu²) strain)^(1/4)."""
    strip = Strip(2e-6, strain=0.03, length=0.7)
    root = (3 * (1 - strip.nu**2) * strip.strain) ** 0.25
    assert strip.wavelength == pytest.approx(math.sqrt(2 * math.pi * strip.length * strip.height) / root, rel=1e-12)


@pytest.mark.parametrize("phase", [0.0, 0.7, 2.0])
def test_a_packet_of_waves_has_its_wavelength(phase):
    y = np.linspace(-0.1, 0.1, 96)
    packet = 1e-4 * np.cos(2 * math.pi * y / 0.025 + phase) * np.exp(-((y / 0.06) ** 2)) + 1e-3
    assert wavelength(packet, WIDTH * 96 / 95) == pytest.approx(0.025, rel=0.01)


def test_a_flat_shell_has_the_tension_of_its_strain():
    """Without sideways contraction the whole sheet has one Green's strain: E h e² / 2 to a unit of area."""
    strip = Strip(1e-3, strain=0.05, nu=0.0)
    mesh = Quarter(strip, (4, 3))
    found = settle(mesh, strip, mesh.rest, 0.0, 1e4, 1e-10, 60)
    green = strip.strain + strip.strain**2 / 2
    assert found.energy == pytest.approx(0.5 * strip.stretch * green**2 * strip.length * WIDTH / 4, rel=1e-9)
    assert found.place[..., 2] == pytest.approx(0, abs=1e-12)
    assert found.place[0, 0, 0] == pytest.approx(-strip.strain * strip.length / 2)


def test_a_thick_shell_stays_flat_and_a_thin_one_wrinkles():
    """A coarse shell has the wavelength of the formula within a quarter; the errors of fine ones are on the page."""
    thick, thin = Strip(6e-6), Strip(2e-7)
    assert float(np.ptp(shell(thick, (8, 12)).across)) < 0.01 * thick.height
    found = shell(thin, (10, 16))
    assert float(np.ptp(found.across)) > thin.height
    assert wavelength(found.across, WIDTH) == pytest.approx(thin.wavelength, rel=0.25)
    assert 0.5 < found.reach < 1


def test_points_on_a_coarse_grid_are_stretched_and_stay_flat():
    """The ends travel as far as they should, and a sheet on few cells is too stiff to wrinkle."""
    found = wrinkles(1e-7, cells=8, rest=2.0, shell_cells=14)
    assert found["stretched"] == pytest.approx(0.05, rel=0.05)
    assert (found["wavelength"], found["error"]) == (0, -1)
    assert found["amplitude"] < 0.5 < found["exact_amplitude"]
    assert all(math.isfinite(value) for value in found.values())
