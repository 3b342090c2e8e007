"""Bars against the linear wave equation and statics, exact for fixed corotated elasticity at any strain."""

import cmath
import dataclasses
import math

import pytest
import torch
from bench.problems.bars import DENSITY, LENGTH, YOUNG, hanging_bar, vibrating_bar
from bench.problems.settings import Settings, fit_sinusoid

TOTAL, UPDATED, MLS = Settings(), Settings("updated"), Settings("updated", mls=True)
VARIANTS = pytest.mark.parametrize("settings", [UPDATED, MLS], ids=["updated", "mls"])


def _fixed(settings, cells, nu=0.3):
    """A constant substep of Courant number 0.3, the same share of each frame of a free bar."""
    speed = math.sqrt(YOUNG * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / DENSITY)
    frame = 2 * LENGTH / speed / 16
    return dataclasses.replace(settings, substep=frame / math.ceil(frame * speed * cells / (0.3 * LENGTH)))


def _order(coarse, fine, ratio=2.0):
    return math.log(coarse["error"] / fine["error"]) / math.log(ratio)


def test_sinusoid_is_found_to_round_off():
    time = torch.linspace(0, 5, 81, dtype=torch.float64)
    omega, rate = fit_sinusoid(time, 3 * torch.exp(-0.1 * time) * torch.sin(4.2 * time - 0.3))
    assert omega == pytest.approx(4.2, rel=1e-10)
    assert rate == pytest.approx(0.1, rel=1e-9)


@pytest.mark.slow(gate=["confined"])
@pytest.mark.parametrize(("confined", "nu"), [(True, 0.3), (False, 0.0)], ids=["confined", "slender"])
def test_free_bar_vibrates_at_its_frequency(confined, nu):
    """Strain 0.1. Each half is a fixed-free bar; 64 cells, and second order."""
    cells = (16, 32, 64) if confined else (16, 64)
    runs = [vibrating_bar(n, _fixed(TOTAL, n, nu), confined=confined, poisson_ratio=nu, periods=2) for n in cells]
    assert runs[-1]["error"] < 0.005
    for n, m, a, b in zip(cells, cells[1:], runs, runs[1:], strict=False):
        assert _order(a, b, m / n) > 1.8


@pytest.mark.slow(gate=["updated"])
@VARIANTS
def test_free_bar_of_the_updated_formulation(settings):
    """Second order at a strain so small that hardly a point changes its cell; no gate at a large one but sanity."""
    small = [vibrating_bar(n, _fixed(settings, n), periods=2, strain=0.001) for n in (16, 32)]
    assert _order(*small) > 1.8
    assert vibrating_bar(32, settings, periods=2)["error"] < 0.005


def _keeps(theta):
    """What APIC keeps of a wave of ``theta`` radians a cell in one transfer, two points to a cell (1D)."""

    def weight(x):
        return 0.75 - x * x if abs(x) < 0.5 else 0.5 * max(1.5 - abs(x), 0.0) ** 2

    mass = kept = 0.0
    for x in (k / 2 + 0.25 for k in range(-4, 4)):  # the points around the node at 0
        nodes = [(i, weight(x - i) * cmath.exp(1j * theta * i)) for i in range(-4, 5)]
        velocity, affine = sum(w for _, w in nodes), 4 * sum(w * (i - x) for i, w in nodes)
        mass, kept = mass + weight(x), kept + weight(x) * (velocity - affine * x)
    return (kept / mass).real


def test_total_formulation_keeps_the_amplitude():
    """A constant substep loses nothing; APIC loses what its transfers smooth, of the kinetic half of the energy."""
    assert _keeps(math.pi / 3) == pytest.approx(1 - 99 / 4096, rel=1e-12)
    assert abs(vibrating_bar(16, _fixed(TOTAL, 16))["loss"]) < 1e-6
    # small, so that points keep their places in their cells
    cells, periods = 16, 2
    updated = vibrating_bar(cells, _fixed(UPDATED, cells), periods=periods, strain=0.001)
    lost = 0.5 * (1 - _keeps(math.pi / cells)) * updated["substeps"] / periods
    # the stencils of the last two cells at each end see fewer points: a quarter of the bar
    assert updated["loss"] == pytest.approx(lost, rel=0.25)
    # measured: the changes of an adaptive substep act on the energy to first order in its length
    assert abs(vibrating_bar(16, TOTAL)["loss"]) < 2e-3


@pytest.mark.parametrize("fine", [32, pytest.param(64, marks=pytest.mark.slow)])
def test_pinned_end_stands_a_quarter_cell_off(fine):
    r"""A clamp whose face lies on a plane of nodes holds them and those behind.

    Two points to a cell couple the slopes between nodes by 3 : 10 : 3, so the slope falls by -1/3 from one to the next
    and the displacement is that of a bar longer by :math:`\sum_{j \ge 1} -(-1/3)^j = 1/4` cell, a first-order error.
    """
    for cells in (16, fine):
        run = vibrating_bar(cells, TOTAL, ends="fixed-free", periods=2)
        assert run["end_shift"] == pytest.approx(0.25, abs=0.5 / cells)
    assert run["error"] < 0.32 / fine
    run = hanging_bar(32, TOTAL, clamp="pin")
    assert run["end_shift"] == pytest.approx(0.25, abs=0.005)
    assert run["error"] == pytest.approx(2 * 0.25 / 32, abs=0.001)


def test_pinned_end_in_updated_holds_all_that_it_touches():
    run = vibrating_bar(32, UPDATED, ends="fixed-free", periods=2)
    assert run["end_shift"] == pytest.approx(-0.75, abs=0.05)


@pytest.mark.slow(gate=["0.3"])
@pytest.mark.parametrize("shift", [0.0, 0.3, 0.45])
def test_points_of_the_wall_hold_where_they_are(shift):
    """Wherever the wall lies on the grid: within half a percent and of second order, without material beyond it."""
    runs = [vibrating_bar(cells, TOTAL, ends="fixed-free", periods=2, shift=shift, hold="points") for cells in (8, 16)]
    assert runs[1]["error"] < 0.002
    assert runs[0]["error"] / runs[1]["error"] > 2**1.8
    assert abs(runs[1]["end_shift"]) < 0.05
    assert abs(runs[1]["loss"]) < 1e-4
    run = hanging_bar(16, TOTAL, clamp="points", shift=shift)
    assert run["error"] < 0.001
    both = vibrating_bar(16, TOTAL, ends="fixed", periods=2, shift=shift, hold="points")
    assert both["error"] < 0.01


@pytest.mark.slow(twin="test_points_of_the_wall_hold_where_they_are")
def test_hanging_bar_stretches_as_it_should():
    """Strain up to 0.3: the tip within 1 % at 32 cells, and second order."""
    runs = [hanging_bar(cells, TOTAL) for cells in (8, 16, 32)]
    assert runs[-1]["error"] < 0.01
    assert runs[-1]["profile"] < 0.01
    assert runs[-1]["residual"] < 1e-4
    assert _order(runs[0], runs[1]) > 1.8
    assert _order(runs[1], runs[2]) > 1.8


@pytest.mark.slow(gate=["mls"])
@VARIANTS
def test_hanging_bar_of_the_updated_formulation(settings):
    assert hanging_bar(16, settings)["error"] < 0.01
