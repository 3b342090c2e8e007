r"""The motion of a rigid body, from the momentum of its points.

A substep moves points by :math:`x' = x + \Delta t\, v`. With a velocity :math:`V + \omega \times r` the body would
grow. So the velocity is that of the chord, :math:`v = V + (Q - 1)\, r / \Delta t` with a rotation Q, for which
:math:`x' = c' + Q r` is the same body. Q follows from the angular momentum L: with :math:`J = \sum m\, r r^T`,
:math:`\sum m\, r \times Q r = \Delta t\, L`. For a turn :math:`\varphi`, whose rotation is
:math:`1 + a [\varphi] + b [\varphi]^2` (Rodrigues), it is :math:`a I \varphi + b J \varphi \times \varphi = \Delta t L`
with :math:`I = \operatorname{tr} J - J`. These are the equations of Moser & Veselov (1991), "Discrete versions of some
classical integrable systems": momenta are conserved to round-off, and the energy does not drift.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import cofactor, determinant, matmul3
from gaussian_swaying.geometry.rotations import rodrigues, turn_of

ITERATIONS = 4  # each gains as many digits as the squared angle of a substep has


def rigid_velocity(place: Tensor, velocity: Tensor, mass: Tensor, dt: float | Tensor) -> Tensor:
    """The velocities of a rigid motion that have the linear and angular momentum of the given ones.

    Args:
        place: Places of the points [m], shape (..., K, 3).
        velocity: Their velocities [m/s], shape (..., K, 3).
        mass: Their masses [kg], shape (..., K); points without mass get the velocity of the motion, too.
        dt: Substep [s], after which the points at ``place + dt * velocity`` have the distances of before.

    Returns:
        Shape (..., K, 3). Without any mass all is zero. Points on a line may get any rotation about it.
    """
    weight, mean = mass[..., None], centre(velocity, mass)
    arm = place - centre(place, mass)
    moment = _outer(weight * arm, arm)
    spin = _axial(_outer(velocity - mean, weight * arm)) * dt
    identity = torch.eye(3, dtype=mass.dtype, device=mass.device)
    trace = moment.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    inertia = trace * identity - moment
    inverse = symmetric_inverse(inertia)
    first = (inverse @ spin[..., None])[..., 0]
    turn = first
    for _ in range(ITERATIONS):
        sine, cosine = rodrigues(turn)
        gyro = torch.linalg.cross((moment @ turn[..., None])[..., 0], turn, dim=-1)
        turn = (first - cosine * (inverse @ gyro[..., None])[..., 0]) / sine
    return mean + matmul3(arm, turn_of(turn).mT) / dt


def fitted_gradient(rest: Tensor, field: Tensor, mass: Tensor) -> Tensor:
    """Gradient of the affine fit to a field, by weighted least squares.

    Args:
        rest: Places at rest [m], shape (..., K, 3), not all in a plane.
        field: Its values, shape (..., K, 3).
        mass: Weights, shape (..., K).

    Returns:
        Shape (..., 3, 3).
    """
    arm = rest - centre(rest, mass)
    moved = _outer(field - centre(field, mass), mass[..., None] * arm)
    return matmul3(moved, symmetric_inverse(_outer(mass[..., None] * arm, arm)))


def centre(field: Tensor, mass: Tensor) -> Tensor:
    """The mean of a field (..., K, 3), weighted with masses (..., K); shape (..., 1, 3)."""
    whole = mass.sum(-1)[..., None, None].clamp(min=torch.finfo(mass.dtype).tiny)
    return (mass[..., None] * field).sum(-2, keepdim=True) / whole


def symmetric_inverse(matrix: Tensor) -> Tensor:
    """The inverse of symmetric matrices (..., 3, 3) without waiting for a GPU; finite for singular ones."""
    finfo = torch.finfo(matrix.dtype)
    scale = matrix.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None].clamp(min=finfo.tiny**0.25)
    matrix = matrix / scale
    cof = cofactor(matrix)
    return cof / determinant(matrix, cof).clamp(min=finfo.eps)[..., None, None] / scale


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """The sum of a bᵀ over points, shape (..., 3, 3)."""
    return a.mT @ b


def _axial(matrix: Tensor) -> Tensor:
    """The sum of r x w for a matrix that is the sum of w rᵀ, shape (..., 3)."""
    skew = matrix - matrix.mT
    return torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
