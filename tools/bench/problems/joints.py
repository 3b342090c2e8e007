r"""A bar that hangs at a hinge, and two beams that a joint connects, compared with closed forms."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bench.problems.beams import first_zero
from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.mpm.joints import Joints, PointJoint
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import stable_limit
from gaussian_swaying.mpm.total import Total

REACH = 1.0  # points so near to a joint are held by it [cells]
LAYERS = 4  # through the thickness of a cell


def _beam(start: float, length: float) -> Tensor:
    """Points of a square beam along x, of a cell's thickness, the middle line at y = z = 0 [cells]; float64."""
    along = start + (torch.arange(round(length * LAYERS), dtype=torch.float64) + 0.5) / LAYERS
    across = (torch.arange(LAYERS, dtype=torch.float64) + 0.5) / LAYERS - 0.5
    return torch.cartesian_prod(along, across, across)


def _body(place: Tensor, attached: Tensor | None, settings: Settings) -> MaterialPoints:
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    return MaterialPoints.create(
        place.to(like), volume=LAYERS**-3, density=1.0, youngs_modulus=1.0, poisson_ratio=0.0, attached=attached
    )


def _ratio(
    settings: Settings, points: MaterialPoints, joint: PointJoint, shape: Tensor, omega: float, gravity: float = 0.0
) -> Result:
    joints = Joints(points, [joint], float(stable_limit(points, 1.0).amin()))
    solver = settings.solver(1.0, gravity=(gravity, 0.0, 0.0))
    weight = points.mass.double().cpu()[:, None] * shape
    start = solver.init_state(points, (1e-3 * omega * shape).to(points.position))

    def speed(state: MPMState) -> Tensor:
        return (weight * state.velocity.double().cpu()).sum()

    if gravity:  # it comes to rest first, as its weight, all at once, would shake it
        calm = settings.solver(1.0, gravity=(gravity, 0.0, 0.0), damping=0.1)
        rest = follow(calm, calm.init_state(points), 150.0, 1, speed, force=joints).state
        assert isinstance(solver.bound, Total)
        assert rest.node_displacement is not None
        assert start.node_velocity is not None
        start = solver.bound.read_particles(start, rest.node_displacement, start.node_velocity)
    run = follow(solver, start, 2.4 / omega / 40, 40, speed, force=joints)
    crossing = first_zero(run.time, run.series.reshape(-1))
    ratio = 0.0 if crossing is None else math.pi / 2 / (omega * crossing)
    return run.result(abs(ratio - 1), ratio=ratio)


def pendulum(settings: Settings, length: float = 12.0) -> Result:
    r"""A bar that hangs at a hinge at its end and swings, :math:`\omega^2 = m g c / I` with its centre at c.

    Its weight stretches it by a thousandth, and lumped masses have a moment of inertia that is larger by
    :math:`m \Delta x^2 / 2`.

    Units: ``length`` [cells].

    Returns:
        ``ratio``: frequency over that of the rigid bar, ``error``: its distance from one, and the common quantities.
    """
    place = _beam(0.0, length)
    inertia = float((place[:, 0] ** 2 + place[:, 2] ** 2).mean())
    omega = 0.005
    gravity = omega**2 * inertia / (0.5 * length)
    near = (place.norm(dim=-1) < REACH).nonzero()[:, 0]
    shape = torch.stack([-place[:, 2], torch.zeros(len(place)), place[:, 0]], -1)
    joint = PointJoint(near, None, (0.0, 0.0, 0.0))
    return _ratio(settings, _body(place, None, settings), joint, shape, omega, gravity)


def joined_beams(settings: Settings, turning: float, length: float = 20.0) -> Result:
    r"""Two free beams in a line that a joint connects, bending up and down together, against Euler's beams.

    Each is free at its far end, and at the joint it has no shear and the moment :math:`E I w'' = 2 \kappa w'`.

    Units: ``length`` [cells].

    Returns:
        ``ratio``: frequency over that of the beams, ``error``: its distance from one, and the common quantities.
    """
    right = _beam(0.0, length)
    place = torch.cat([right, right * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)])
    number = torch.arange(2).repeat_interleave(len(right))
    moment = (1 - 1 / LAYERS**2) / 12
    k, w, slope = lowest_mode(turning, length, right[:, 0])
    half = torch.stack([-slope * right[:, 2], torch.zeros_like(w), w], -1)
    shape = torch.cat([half, half * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)])
    near = place.norm(dim=-1) < REACH
    first, second = ((near & (number == side)).nonzero()[:, 0] for side in (0, 1))
    joint = PointJoint(first, second, (0.0, 0.0, 0.0), turning=turning * moment / length)
    return _ratio(settings, _body(place, number, settings), joint, shape, k**2 * math.sqrt(moment))


def lowest_mode(turning: float, length: float, at: Tensor) -> tuple[float, Tensor, Tensor]:
    r"""Wave number of the lowest mode of :func:`joined_beams`, and its displacement and slope at places along a beam.

    With :math:`w = A (\cos kx + \cosh kx) + B (\sin kx + \sinh kx + q \cosh kx)` and
    :math:`q = 4 \kappa / (E I k)`, shear and moment vanish at the far end.
    """

    def terms(k: float) -> tuple[float, float, float, float]:
        c, s, ch, sh = math.cos(k), math.sin(k), math.cosh(k), math.sinh(k)
        if math.isinf(turning):
            return ch - c, ch, s + sh, sh
        q = 4 * turning / k
        return ch - c, q * ch + sh - s, s + sh, q * sh + ch - c

    def determinant(k: float) -> float:
        a, b, c, d = terms(k)
        return a * d - b * c

    low, high = 0.05, 0.06
    while determinant(low) * determinant(high) > 0:
        low, high = high, high + 0.01
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if determinant(low) * determinant(middle) <= 0 else (middle, high)
    a, b, _, _ = terms(low)
    x = low * at / length
    hyper = torch.cosh(x) if math.isinf(turning) else torch.sin(x) + torch.sinh(x) + 4 * turning / low * torch.cosh(x)
    slope = torch.sinh(x) if math.isinf(turning) else torch.cos(x) + torch.cosh(x) + 4 * turning / low * torch.sinh(x)
    w = b * (torch.cos(x) + torch.cosh(x)) - a * hyper
    turn = (b * (torch.sinh(x) - torch.sin(x)) - a * slope) * low / length
    size = w.abs().amax()
    return low / length, w / size, turn / size
