"""The kernel of the forces on the sites of ``modes``, against torch."""

import pytest
import torch
from shared import peak, seeded, solid, unit, up_to

from gaussian_swaying import AeroForce, MaterialPoints, MPMSolver, WindField, WindForce
from gaussian_swaying.mpm.modes import Modes
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.wind.effects import Profile
from gaussian_swaying.wind.patches import Patches
from gaussian_swaying.wind.turbulence import look

DT, STEPS = 0.01, 4


def post(device, scale=1.0):
    """A post of 0.2 x 0.2 x 1 m with two patches of random directions on each point."""
    axes = (torch.linspace(0, 0.2, 4), torch.linspace(0, 0.2, 4), torch.linspace(0, 1, 20))
    place = torch.cartesian_prod(*axes).to(device)
    count, generator = len(place), seeded(0)
    points = solid(place, 0.04 / count, 100.0, 2e5 * scale, damping=0.5)
    normal = unit(2 * count, 3, generator=generator, dtype=torch.float32).to(device)
    area = torch.full((2 * count,), 0.3 / count, device=device)
    return points, Patches(normal, area, torch.arange(count, device=device).repeat(2), count)


def solver(**more):
    foot = PinnedRegion(up_to(z=0.05), kind="nodes")
    return MPMSolver(0.1, "modes", gravity=(0, 0, -2.0), boundaries=[foot], **more)


WINDS = {
    "storm": lambda: look("storm"),
    "steady": lambda: WindField([6.0, 2.0, 0.0]),
    "profile": lambda: WindField([6.0, 2.0, 0.0], effects=[Profile(ground=(0.0, 0.0, -0.1), height=1.0)]),
}


@pytest.mark.parametrize("law", ["projected", "paper", "cross_flow"])
@pytest.mark.parametrize("wind", WINDS)
def test_kernel_agrees_with_torch(kernel_device, monkeypatch, wind, law):
    """Both are float32: their difference stays some roundings of the motion, as no mode is unstable."""
    points, patches = post(kernel_device)
    aero = AeroForce(C_D=1.0, C_F=0.1, C_L=0.05, law=law).to(kernel_device)
    force = WindForce(aero, WINDS[wind]().to(kernel_device), patches)
    ends = []
    for kernels in (True, False):
        with monkeypatch.context() as patch:
            if not kernels:
                patch.setattr(Modes, "_kernel", lambda *given: None)
            own = solver()
            state = own.init_state(points)
            for _ in range(5):
                state = own.rollout(state, DT, STEPS, [force])
        ends.append(state)
        assert (own.bound._site_forces is not None) == kernels
    fast, slow = ends
    moved = float(peak(slow.position - points.position))
    assert moved > 0.01
    assert peak(fast.position - slow.position) < 2e-5 * moved
    assert peak(fast.velocity - slow.velocity) < 1e-4 * peak(slow.velocity)
    assert float(fast.work) == pytest.approx(float(slow.work), rel=1e-4)
    assert torch.allclose(fast.impulse, slow.impulse, rtol=1e-4, atol=1e-4 * float(peak(slow.impulse)))


@pytest.mark.parametrize("kernels", [True, False])
def test_scenes_of_a_batch_have_winds_of_their_own(kernel_device, kernels, monkeypatch):
    if not kernels:
        monkeypatch.setattr(Modes, "_kernel", lambda *given: None)
    found = []
    winds = [WindField([4.0, 0.0, 0.0]), WindField([0.0, 7.0, 0.0])]
    aero = AeroForce(C_D=1.0, C_F=0.1, C_L=0.0, law="projected").to(kernel_device)
    both = [post(kernel_device, scale) for scale in (1.0, 3.0)]
    for (points, patches), wind in zip(both, winds, strict=True):
        alone = solver()
        state = alone.init_state(points)
        found.append(alone.rollout(state, DT, 8, [WindForce(aero, wind.to(kernel_device), patches)]).position)
    count = both[0][0].count
    joined = Patches(
        *(torch.cat([getattr(patches, name) for _, patches in both]) for name in ("normal", "area")),
        torch.cat([both[0][1].point, both[1][1].point + count]),
        2 * count,
    )
    own = solver()
    state = own.init_state(MaterialPoints.stack([points for points, _ in both]))
    end = own.rollout(state, DT, 8, [WindForce(aero, [wind.to(kernel_device) for wind in winds], joined)])
    for k in range(2):
        moved = float(peak(found[k] - both[k][0].position))
        assert moved > 1e-3
        assert peak(end.position[k] - found[k]) < 1e-5 * moved + 1.2e-7  # rounding of a place at 1 m


def test_a_gradient_runs_in_torch():
    points, patches = post("cpu")
    aero = AeroForce(C_D=torch.tensor(1.0, requires_grad=True), C_F=0.1, C_L=0.0, law="projected")
    own = solver()
    state = own.init_state(points)
    end = own.rollout(state, DT, STEPS, [WindForce(aero, WindField([6.0, 0.0, 0.0]), patches)])
    assert own.bound._site_forces is None
    (slope,) = torch.autograd.grad(end.position[..., 0].sum(), aero.C_D)
    assert float(slope) > 0
