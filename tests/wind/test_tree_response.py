"""A stiff tree in small turbulence against linear theory: an oscillator that the fluctuating drag drives.

The tree is a stem with a heavy crown, so that its first mode carries nearly all of its motion. Its stiffness is
that of its own deflection in the mean wind, its frequency that of its own sway. Everything else is theory: the drag
of a plate, linear in the fluctuation (rho C A U u'), the damping of the air (rho C A U v) and that of the solver.
"""

import math
from itertools import pairwise

import pytest
import torch
from shared import ZERO, double, peak, solid, up_to

from gaussian_swaying import AeroForce, MPMSolver, PinnedRegion, WindField, WindForce
from gaussian_swaying.wind.turbulence import Turbulence

DOUBLE = torch.float64
SPEED, DRAG, AREA, DAMPING, AIR = 8.0, 1.2, 0.15, 1.0, 1.225
EVERY = 8  # substeps between samples


def _tree():
    axis = 0.1 * (torch.arange(4).double() + 0.5)
    place = torch.cartesian_prod(axis, axis, 0.1 * (torch.arange(12).double() + 0.5))
    crown = place[:, 2] > 0.9
    density = torch.where(crown, 800.0, 300.0)
    points = solid(place, 1e-3, density, 4e5)
    foot = PinnedRegion(up_to(z=0.15), kind="nodes")
    solver = MPMSolver(0.2, gravity=ZERO, damping=DAMPING, boundaries=[foot], transfer="torch")
    area = torch.where(crown, AREA / int(crown.sum()), 0.0).to(DOUBLE)
    normal = double([1.0, 0.0, 0.0]).expand_as(place)
    return solver, solver.init_state(points), crown, normal, area


def _sway(wind, seconds):
    """Mean displacement of the crown along x over time [m], the time between samples, and the load."""
    solver, state, crown, normal, area = _tree()
    load = WindForce(AeroForce(C_D=DRAG, C_F=0.0, C_L=0.0, air_density=AIR), wind, normal, area)
    dt = solver.stable_substep(state)
    rest, found = state.position[crown, 0].mean(), []
    for _ in range(round(seconds / (EVERY * dt))):
        found.append(state.position[crown, 0].mean() - rest)
        state = solver.rollout(state, dt, EVERY, load)
    return torch.stack(found), EVERY * dt, state.time, (solver, crown)


@pytest.mark.slow
def test_the_response_spectrum_is_that_of_linear_theory():
    calm, step, _, (solver, crown) = _sway(WindField([SPEED, 0.0, 0.0]), 9.0)
    mean = calm[len(calm) // 2 :].mean()  # it has settled to e^-4
    stiffness = 0.5 * AIR * DRAG * AREA * SPEED**2 / float(mean)
    swing = calm - mean
    rising = ((swing[:-1] < 0) & (swing[1:] >= 0)).nonzero()[:, 0]
    share = -swing[rising] / (swing[rising + 1] - swing[rising])
    turns = (rising + share)[:8]
    frequency = 1 / (step * float(turns[-1] - turns[0]) / (len(turns) - 1))
    omega = 2 * math.pi * frequency
    mass = stiffness / omega**2
    own = float(solver.points.mass[crown].sum())
    assert own < mass < 1.6 * own  # the crown, its turning, a part of the stem, and the spread over the nodes
    # the frequency above is the damped one; the shift, 1 - zeta^2 / 2, is 0.1 %
    rate = 0.5 * DAMPING + 0.5 * AIR * DRAG * AREA * SPEED / mass
    assert rate / omega < 0.08
    peaks = torch.stack([peak(swing[a:b]) for a, b in pairwise(rising[:7].tolist())])
    decay = float((peaks[0] / peaks[-1]).log()) / (5 / frequency)
    assert decay == pytest.approx(rate, rel=0.1)

    gusts = WindField([SPEED, 0.0, 0.0], effects=[Turbulence(0.05, 1.5, cells=[256, 32, 32], spacing=0.25, seed=3)])
    found, step, _, _ = _sway(gusts, 40.0)
    place = _tree()[1].position[crown]
    times = step * torch.arange(len(found)).double()
    wind = torch.stack([gusts.at(t, place)[:, 0].mean() for t in times]) - SPEED
    # the oscillator, exact for a force that is linear between samples of a twentieth of a period or less
    force = AIR * DRAG * AREA * SPEED * wind + 0.5 * AIR * DRAG * AREA * SPEED**2
    x, v, expected = 0.0, 0.0, []
    parts = 8
    for k in range(len(times)):
        expected.append(x)
        after = force[min(k + 1, len(times) - 1)]
        for part in range(parts):
            pull = float(torch.lerp(force[k], after, (part + 0.5) / parts))
            v += step / parts * (pull / mass - omega**2 * x - 2 * rate * v)
            x += step / parts * v
    expected = double(expected)
    late = slice(round(6.0 / step), None)
    window = torch.hann_window(len(times[late]), dtype=DOUBLE)
    spectra = [torch.fft.rfft(window * (one[late] - one[late].mean())).abs().square() for one in (found, expected)]
    f = torch.fft.rfftfreq(len(times[late]), step, dtype=DOUBLE)
    for low, high in ((0.1, 0.6), (0.6, 0.9), (0.9, 1.1), (1.1, 1.6)):  # below, at and above the resonance
        band = (f > low * frequency) & (f <= high * frequency)
        assert int(band.sum()) >= 4
        ratio = float(spectra[0][band].sum() / spectra[1][band].sum())
        assert ratio == pytest.approx(1.0, abs=0.1), (low, high)
    assert float(found[late].var() / expected[late].var()) == pytest.approx(1.0, abs=0.1)
    assert found[late].std() < 0.02  # small, to one that is 1.2 m high
