import pytest
import torch
from shared import seeded

from gaussian_swaying.player.live_web.longest import MARGIN, fastest_vibration, longest_courant


@pytest.mark.parametrize("law", ["FixedCorotated", "SpringNetwork"])
def test_what_shakes_grows_only_beyond_the_largest_stable_step(make, law):
    solver = {"boundaries": [], "damping": 0.0, "gravity": [0.0, 0.0, 0.0]}
    simulation = make(solver=solver, material={"law": {"class_path": law}, "nu": 0.25})
    rest, bound = simulation.start(), simulation.solver.bound
    limit = 2 / fastest_vibration(bound)
    wave = (bound.laws.lam + 2 * bound.laws.mu)[0] * rest_volume(bound)
    assert longest_courant(bound) == pytest.approx(MARGIN * limit * float(wave) ** 0.5 / bound.settings.dx, rel=1e-5)
    speed = 1e-4 * torch.randn(rest.node_velocity.shape, generator=seeded(0))
    speed = torch.where(bound.node_inverse_mass[:, None] > 0, speed.to(rest.node_velocity), 0.0)
    start = bound.read_particles(rest, torch.zeros_like(speed), speed)
    grown = []
    for share in (0.97, 1.05):
        state = start
        for _ in range(150):
            state = bound.step(state, share * limit, None, None)
        grown.append(float(bound.kinetic(state) / bound.kinetic(start)))
    assert grown[0] < 20
    assert not grown[1] < 1e4


def rest_volume(bound):
    """Volume over mass of the first point [m³/kg]."""
    return float((bound.points.volume / bound.points.mass)[0])
