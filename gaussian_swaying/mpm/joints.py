r"""Joints between parts of the material: springs between the points around two places, against parting and turning.

A set of points has a centre c, a rotation R, that of the polar decomposition of :math:`\sum m\,r\,r_0^T` with the arms
r from its centre now and at rest, and an anchor :math:`c + R d`, at rest the place of the joint. The force
:math:`-k\,(a - b)` acts between the anchors a and b of two sets, and the torque :math:`-\kappa\,\theta` between
them, with the turn :math:`\theta` of :math:`R_a R_b^T`. Both are spread over the points of a set as over a rigid body:
a force in proportion to the masses, and a torque T as :math:`m\,(I^{-1} T) \times r`, the transpose of how c and R
follow the points. Momentum and angular momentum are conserved.

**Stability.** Spread like this, a force meets at least the mass M of its set, whatever nodes its points share, and a
torque at least its moment of inertia: the relative acceleration of the anchors is at most :math:`\alpha f` with
:math:`\alpha = \sum 1 / M + d^2 / I_{min}`. Symplectic Euler is stable for :math:`k\,\alpha\,\Delta t^2 < 4`, of which
the elasticity of the material takes most at the longest substep. So a spring is softened to

.. math:: \tilde k = \left( 1 / k + \alpha\,\Delta t^2 / s \right)^{-1}

with s = :data:`SHARE` and the longest stable substep of the material; with a Courant number of 0.4 both together stay
below 4. A joint never shortens the substep; one of infinite stiffness yields by :math:`f \alpha \Delta t^2 / s`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.rigid import symmetric_inverse
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.state import MaterialPoints, State

FEW = 0.01  # weight of the deformation gradients in the rotation of a set, for sets in a plane or on a line
SHARE = 2.0  # of k alpha dt^2, which may be 4 without any other force


@dataclass(frozen=True)
class PointJoint:
    """A joint between the points of two sets, or of one and a place.

    Args:
        first: Numbers of the points of the first set, shape (n,).
        second: Numbers of the points of the second set, shape (m,); None for a place that does not move.
        at: The place of the joint at rest [m].
        stiffness: Of the spring [N/m]; infinite for a joint that holds.
        turning: Stiffness against turning [N m/rad]; zero for a hinge to all sides, infinite where nothing turns.
    """

    first: Tensor
    second: Tensor | None
    at: Sequence[float]
    stiffness: float = math.inf
    turning: float = 0.0


class Joints(Force):
    """The forces of some joints, all at once.

    Args:
        points: The material, of one scene.
        joints: The joints.
        longest: Longest substep that is stable without them [s].

    Raises:
        ValueError: If a set is empty, or a stiffness is negative.

    Attributes:
        stiffness: Of each joint as it acts, softened as a substep needs it [N/m], shape (J,).
        turning: The same against turning [N m/rad], shape (J,).
    """

    recordable = True
    stiffness: Tensor
    turning: Tensor
    index: Tensor
    of: Tensor
    mass: Tensor
    arm: Tensor
    size: Tensor
    whole: Tensor
    offset: Tensor
    extra: Tensor
    owner: Tensor
    sign: Tensor
    place: Tensor
    still: Tensor

    def __init__(self, points: MaterialPoints, joints: Sequence[PointJoint], longest: float) -> None:
        super().__init__()
        like = points.position.detach()
        sets = [joint.first for joint in joints] + [j.second for j in joints if j.second is not None]
        for joint in joints:
            if not joint.stiffness >= 0 or not joint.turning >= 0:
                raise ValueError(
                    f"Expected the stiffnesses of a joint not to be negative, but got {joint.stiffness:g} N/m and "
                    f"{joint.turning:g} N m/rad."
                )
        if any(len(own) == 0 for own in sets):
            raise ValueError("A joint has no points: give it some of each part.")
        count = len(sets)
        index = torch.cat([own.to(like.device) for own in sets])
        of = torch.repeat_interleave(torch.arange(count), torch.tensor([len(own) for own in sets])).to(like.device)
        mass = points.mass.detach()[index]
        whole = mass.new_zeros(count).index_add(0, of, mass)
        centre = self._mean(like[index], mass, whole, of)
        arm = like[index] - centre[of]
        eye, size = torch.eye(3).to(like), self._mean(arm.square().sum(-1), mass, whole, of)
        main, axes = torch.linalg.eigh(_inertia(self._mean(arm[:, :, None] * arm[:, None], mass, whole, of)).double())
        none = main <= 1e-6 * main[:, 2:]  # a line feels no torque about itself
        extra = (axes * torch.where(none, main[:, 2:], 0.0)[:, None]) @ axes.mT
        least = torch.where(none, math.inf, main) * whole.double()[:, None]
        paired = [j for j, joint in enumerate(joints) if joint.second is not None]
        owner = torch.tensor([*range(len(joints)), *paired]).to(like.device)
        at = torch.tensor([list(joint.at) for joint in joints]).to(like)
        check_shape("at", at, None, 3)
        offset = at[owner] - centre
        light = (1 / least).amax(-1).to(like)
        easy = 1 / whole + offset.square().sum(-1) * light
        total, turn = (at.new_zeros(len(joints)).index_add(0, owner, part) for part in (easy, light))
        stiffness, turning = (torch.tensor([getattr(j, n) for j in joints]).to(like) for n in ("stiffness", "turning"))
        rigid = longest**2 / SHARE
        place = torch.ones(len(joints), dtype=torch.bool)
        place[paired] = False
        still = place.to(like.device)[:, None].to(like)
        buffers = {
            "stiffness": 1 / (1 / stiffness + rigid * total),
            "turning": 1 / (1 / turning + rigid * turn),
            **{"index": index, "of": of, "mass": mass, "arm": arm, "size": size, "whole": whole, "offset": offset},
            **{"extra": extra.to(like), "owner": owner, "place": still * at, "still": still[:, None] * eye},
            "sign": torch.where(torch.arange(count) < len(joints), 1.0, -1.0).to(like),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value)

    @staticmethod
    def _mean(field: Tensor, mass: Tensor, whole: Tensor, of: Tensor) -> Tensor:
        shape = (-1, *[1] * (field.dim() - 1))
        found = field.new_zeros(len(whole), *field.shape[1:]).index_add(0, of, mass.view(shape) * field)
        return found / whole.view(shape)

    def forward(self, state: State) -> Tensor:
        """Force on each point [N], shape (..., P, 3)."""
        batch = state.position.shape[:-2]
        if batch:
            scenes = zip(state.position.flatten(0, -3), state.F_total.flatten(0, -4), strict=True)
            return torch.stack([self._of(*scene) for scene in scenes]).reshape(state.position.shape)
        return self._of(state.position, state.F_total)

    def _of(self, position: Tensor, F: Tensor) -> Tensor:
        moved, joints = position[self.index], len(self.stiffness)
        centre = self._mean(moved, self.mass, self.whole, self.of)
        arm = moved - centre[self.of]
        shape = self._mean(arm[:, :, None] * self.arm[:, None], self.mass, self.whole, self.of)
        own = self._mean(F[self.index], self.mass, self.whole, self.of)
        R = polar_rotation(shape / self.size[:, None, None] + FEW * own)
        reach = (R @ self.offset[:, :, None])[:, :, 0]
        signed = self.sign[:, None] * (centre + reach)
        gap = signed.new_zeros(joints, 3).index_add(0, self.owner, signed) - self.place
        force = -self.stiffness[:, None] * gap
        other = self.still.index_add(0, self.owner[joints:], R[joints:])
        torque = -self.turning[:, None] * turn_between(R[:joints], other)
        push = self.sign[:, None] * force[self.owner]
        twist = self.sign[:, None] * torque[self.owner] + torch.linalg.cross(reach, push)
        inertia = _inertia(self._mean(arm[:, :, None] * arm[:, None], self.mass, self.whole, self.of))
        spin = (symmetric_inverse(inertia + R @ self.extra @ R.mT) @ twist[:, :, None])[:, :, 0]
        each = (push[self.of] + torch.linalg.cross(spin[self.of], arm)) / self.whole[self.of, None]
        return torch.zeros_like(position).index_add(0, self.index, self.mass[:, None] * each)


def _inertia(moment: Tensor) -> Tensor:
    """Moments of inertia from second moments, shape (..., 3, 3)."""
    trace = moment.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    return trace * torch.eye(3, dtype=moment.dtype, device=moment.device) - moment


def turn_between(first: Tensor, second: Tensor) -> Tensor:
    """Axis times angle [rad] of the rotation A Bᵀ, below half a turn, of rotations A and B (..., 3, 3); (..., 3)."""
    change = first @ second.mT
    skew = 0.5 * (change - change.mT)
    axial = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    sine = torch.linalg.vector_norm(axial, dim=-1, keepdim=True)
    cosine = 0.5 * (change.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    small = sine < 1e-6
    return torch.where(small, 1.0, torch.atan2(sine, cosine) / torch.where(small, 1.0, sine)) * axial
