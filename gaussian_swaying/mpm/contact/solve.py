r"""Impulses that keep contact samples of a surface apart, as functions of tensors.

A contact sample (``place`` in the code) is a row :math:`w` of constant weights on the nodes, of mass :math:`m_i`: it is
at :math:`X + \sum_i w_i u_i` and moves with :math:`\sum_i w_i v_i`. An impulse :math:`j` at it changes the nodes by
:math:`w_i j / m_i`. A constraint :math:`k` has a normal :math:`n`, a gap :math:`d` and two samples, or one sample and
an obstacle. Its relative velocity along the normal after the substep must satisfy

.. math:: v_n \ge -d / \Delta t \quad (d > 0), \qquad v_n \ge \min(0.01\,|d| / \Delta t,\; 0.004\,\Delta x / \Delta t)
          \quad (d \le 0),

so that a gap closes at most to zero within a substep, and an overlap is removed in some substeps, at no more than one
per cent of the wave speed (the substep is 0.4 of the time in which a wave crosses a cell). The impulse only pushes
(:math:`\lambda \ge 0`), and Coulomb's friction is at most :math:`\mu\lambda` against the sliding velocity.

The impulses are found by Jacobi's iteration, all at once, with Nesterov's momentum (Mazhar et al. 2015, "Using
Nesterov's method to accelerate multibody dynamics with friction and contact"), so that a pile of n layers takes of
order n iterations. The step of a constraint is one over the sum of the absolute values of its row in
:math:`A = J M^{-1} J^T`, so the iteration cannot overshoot (Gershgorin): for a lone sample it is the mass that the
sample really has, and for a whole area in contact the mass of the area. With :math:`c` constraints at each sample the
sum is bounded by :math:`\sum_i |w_i| s_i / m_i`, :math:`s_i = \sum |w_i| c`, without forming A.

Friction that sticks yields a little: with step :math:`\alpha` and friction :math:`j_t` it leaves the slip
:math:`v_t = -c\,j_t / \alpha`, c = ``CREEP`` (Todorov 2014, "Convex and analytically-invertible dynamics with contacts
and constraints", regularises friction so). The iterations are never finished, and with momentum they overshoot: k of
them leave the share :math:`r_k(\lambda)` of the slip of a mode that one step reduces by :math:`\lambda`. Where it is
negative, friction has pushed the material instead of holding it, in every substep again. What is left with c is
:math:`(c + \lambda\,r_k(\lambda + c)) / (c + \lambda)`. From c = 0.01 on it is nowhere negative, after any number of
iterations.

The two samples of a pair get opposite impulses, so momentum is conserved to round-off; angular momentum up to the
torque of an impulse times the shift of the two samples along the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

PUSH = 0.01
"""Share of an overlap that a substep removes."""

PUSH_CELLS = 0.004
"""Most of an overlap that a substep removes [cells]."""

CREEP = 0.01
"""Creep of sticking friction: the share of the free slip of a substep that a single contact sample keeps."""

SLACK = 0.02
"""Gap up to which a constraint counts as acting [cells]."""


def weighted(field: Tensor, node: Tensor, weight: Tensor, start: Tensor | None = None) -> Tensor:
    """Weighted sums of rows of a field (G, n): nodes and weights of shape (A, 27) give (A, n).

    With ``start``, where each sum begins (A,), nodes and weights are in one row. Ten times faster on a CPU than
    indexing and adding.
    """
    return torch.nn.functional.embedding_bag(node, field, start, per_sample_weights=weight, mode="sum")


@dataclass(frozen=True, slots=True)
class Rows:
    """Contact samples as rows of weights on some nodes; the last one has no weight: it stands for obstacles.

    Attributes:
        node: Nodes of each, shape (A + 1, 27).
        weight: Their weights, shape (A + 1, 27).
        inverse_mass: Inverse mass of the nodes [1/kg], shape (G,).
        place: The rows that have a weight on each node, node after node, shape (27 A + 27,).
        share: Those weights, shape (27 A + 27,).
        start: Index of the first of each node, shape (G,).
    """

    node: Tensor
    weight: Tensor
    inverse_mass: Tensor
    place: Tensor
    share: Tensor
    start: Tensor

    @classmethod
    def of(cls, node: Tensor, weight: Tensor, inverse_mass: Tensor) -> Rows:
        """Rows from the nodes and weights (A, 27) of the samples, and the inverse mass (G,) of the nodes."""
        node = torch.cat([node, node.new_zeros(1, 27)])
        weight = torch.cat([weight, weight.new_zeros(1, 27)])
        order = node.reshape(-1).argsort(stable=True)
        sizes = torch.bincount(node.reshape(-1), minlength=len(inverse_mass))
        place = order.div(27, rounding_mode="floor")
        return cls(node, weight, inverse_mass, place, weight.reshape(-1)[order], sizes.cumsum(0) - sizes)

    def read(self, field: Tensor) -> Tensor:
        """A field of the nodes (G, n) at the samples, shape (A + 1, n)."""
        return weighted(field, self.node, self.weight)

    def push(self, velocity: Tensor, impulse: Tensor) -> Tensor:
        """The velocity of the nodes (G, 3) after impulses at the samples (A + 1, 3)."""
        return velocity + self.inverse_mass[:, None] * weighted(impulse, self.place, self.share, self.start)

    def mobility(self, count: Tensor) -> Tensor:
        """Bound of how much unit impulses at the constraints of all samples move each sample [1/kg], shape (A + 1,).

        Args:
            count: Constraints of each sample, shape (A + 1,).
        """
        total = self.inverse_mass[:, None] * weighted(count[:, None], self.place, self.share.abs(), self.start)
        return weighted(total, self.node, self.weight.abs())[:, 0]


@dataclass(frozen=True, slots=True)
class Constraints:
    """Pairs of samples that must not come closer, M in all.

    Attributes:
        first: The sample that is pushed along the normal, shape (M,).
        second: The one that is pushed against it; the last row for an obstacle, shape (M,).
        normal: Unit normals, shape (M, 3).
        gap: Distance along the normal less the thickness [m], shape (M,).
        drive: Velocity of the obstacle [m/s], zero for a pair, shape (M, 3).
        friction: Coulomb coefficient, shape (M,).
        valid: Whether each counts, bool, shape (M,).
    """

    first: Tensor
    second: Tensor
    normal: Tensor
    gap: Tensor
    drive: Tensor
    friction: Tensor
    valid: Tensor

    def select(self, index: Tensor) -> Constraints:
        names = ("first", "second", "normal", "gap", "drive", "friction", "valid")
        return Constraints(*(getattr(self, name)[index] for name in names))


def acting(moving: Tensor, held: Constraints, dt: float | Tensor, dx: float) -> Tensor:
    """Return a mask of the constraints whose gap comes close to zero in this substep, bool, shape (M,).

    Args:
        moving: Velocity of the samples, and of the one that stands for obstacles [m/s], shape (A + 1, 3).
        held: The constraints.
        dt: Substep [s].
        dx: Grid spacing [m].
    """
    with torch.no_grad():
        relative = moving[held.first] - moving[held.second] - held.drive
        ahead = held.gap + dt * (relative * held.normal).sum(-1)
        return held.valid & (ahead.minimum(held.gap) < SLACK * dx)


def resolve(
    velocity: Tensor,
    rows: Rows,
    held: Constraints,
    dt: float | Tensor,
    dx: float,
    iterations: int,
    tolerance: float | None = None,
) -> tuple[Tensor, Tensor]:
    """The velocity of the nodes after the impulses of all constraints; see the module.

    Differentiable, except where a constraint begins or ends to act or to slide.

    Args:
        velocity: Node velocity [m/s], shape (G, 3).
        rows: The places.
        held: The constraints that act; those that are not ``valid`` do nothing.
        dt: Substep [s].
        dx: Grid spacing [m].
        iterations: Largest number of iterations.
        tolerance: Stop if no constraint is violated by more than this within the substep [m]; the host waits. None to
            make all iterations.

    Returns:
        The velocity, shape (G, 3), and the impulse on the first sample of each constraint [N s], shape (M, 3).
    """
    dt_ = torch.as_tensor(dt, device=velocity.device).to(velocity)
    valid = held.valid.to(velocity)
    count = velocity.new_zeros(len(rows.node)).index_add_(0, held.first, valid).index_add_(0, held.second, valid)
    mobility = rows.mobility(count)
    both = mobility[held.first] + mobility[held.second]
    step = torch.where(held.valid & (both > 0), 1 / torch.where(both > 0, both, 1.0), 0.0)
    overlap = (-held.gap * PUSH).clamp(max=PUSH_CELLS * dx)
    target = torch.where(held.gap > 0, -held.gap, overlap) / dt_
    normal, tiny = held.normal, torch.finfo(velocity.dtype).tiny
    pressed, rubbed = torch.zeros_like(held.gap), torch.zeros_like(normal)
    applied, theta = torch.zeros_like(normal), torch.ones_like(dt_)
    back = torch.zeros_like(dt_, dtype=torch.bool)  # whether the momentum led the wrong way: it then starts again
    for k in range(iterations):
        moving = rows.read(velocity)
        relative = moving[held.first] - moving[held.second] - held.drive
        along = (relative * normal).sum(-1)
        lacking = torch.where(held.valid, target - along, 0.0)
        if tolerance is not None and k > 0 and float(lacking.detach().amax() * dt_) < tolerance:
            break
        ahead = (applied * normal).sum(-1)
        press = (ahead + step * lacking).clamp(min=0.0)
        rub = (1 - CREEP) * (applied - ahead[:, None] * normal) - step[:, None] * (relative - along[:, None] * normal)
        length = (rub * rub).sum(-1).clamp(min=tiny).sqrt()
        rub = rub * (held.friction * press / length).clamp(max=1.0)[:, None]
        new, old = press[:, None] * normal + rub, pressed[:, None] * normal + rubbed
        following = 0.5 * (1 + (1 + 4 * theta * theta).sqrt())
        momentum = torch.where(back, 0.0, (theta - 1) / following)
        theta = torch.where(back, torch.ones_like(theta), following)
        wanted = new if k == iterations - 1 else new + momentum * (new - old)
        velocity = _push(velocity, rows, held, wanted - applied)
        back = ((applied - new) * (new - old)).sum().detach() > 0
        applied, pressed, rubbed = wanted, press, rub
    end = pressed[:, None] * normal + rubbed
    return _push(velocity, rows, held, end - applied), end


def _push(velocity: Tensor, rows: Rows, held: Constraints, impulse: Tensor) -> Tensor:
    """The velocity after impulses (M, 3) on the first samples, and the opposite on the second."""
    total = velocity.new_zeros(len(rows.node), 3).index_add(0, held.first, impulse)
    return rows.push(velocity, total.index_add(0, held.second, -impulse))


def pair_gaps(
    arm: Tensor, normals: tuple[Tensor, Tensor], radii: tuple[Tensor, Tensor], thickness: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Normal and gap of pairs of discs.

    A disc counts if the centre of the other lies above it. The normal is
    :math:`\sum w\,(\Delta x \cdot n)\,n` over the two, normalised: it needs no orientation of the normals, points from
    the second to the first, and for an edge that meets a face it is the normal of the face.

    Args:
        arm: From the second sample to the first [m], shape (M, 3).
        normals: Unit normals of the first and the second, of either sign, shape (M, 3) each.
        radii: Radii of their discs [m], shape (M,) each.
        thickness: Distance that they keep [m], shape (M,).

    Returns:
        Unit normals, shape (M, 3), gaps [m], shape (M,), and whether they are above each other, bool, shape (M,).
    """
    squared = (arm * arm).sum(-1)
    total, above = torch.zeros_like(arm), torch.zeros_like(squared, dtype=torch.bool)
    for facing, radius in zip(normals, radii, strict=True):
        height = (arm * facing).sum(-1)
        over = squared - height * height < radius * radius
        total = total + torch.where(over, height, 0.0)[:, None] * facing
        above = above | over
    tiny = torch.finfo(arm.dtype).tiny ** 0.5
    length = (total * total).sum(-1).clamp(min=tiny * tiny).sqrt()
    known = length > tiny
    normal = torch.where(known[:, None], total / length[:, None], normals[1])
    return normal, (arm * normal).sum(-1) - thickness, above
