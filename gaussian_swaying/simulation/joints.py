"""The joints of parts as sets of material points."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.joints import PointJoint

REACH, LEAST = 1.0, 3  # points so near to a joint hold it [cells], and at least so many of each part
NEXT = 1.5  # a joint is in the middle between pairs of Gaussians at most so many times as far apart as the nearest


@torch.no_grad()
def joints_of(
    parts: Parts, labels: Tensor, place: Tensor, owner: Tensor, position: Tensor, dx: float
) -> tuple[PointJoint, ...]:
    """The joints of parts.

    Args:
        parts: The parts.
        labels: The part of each simulated Gaussian, shape (N,).
        place: Their rest positions [m], shape (N, 3).
        owner: The material point that each belongs to, shape (N,).
        position: Rest positions of the material points [m]; of a sheet of three layers those of the layers one after
            the other, shape (P, 3).
        dx: Grid spacing [m].
    """
    names, found = [part.name for part in parts.parts], []
    first_layer = int(owner.max()) + 1
    of = torch.full((first_layer,), -1).index_copy(0, owner, labels).repeat(len(position) // first_layer)
    for k, part in enumerate(parts.parts):
        if not part.has_joint:
            continue
        assert part.attached is not None
        sets = []
        for other in (k, names.index(part.attached)):
            if not bool((of == other).any()):
                raise ValueError(
                    f"The part {names[other]!r} has no Gaussian that is simulated, so there is no joint of the part "
                    f"{part.name!r}: name one that is, or remove the joint."
                )
            sets.append(other)
        mine, theirs = (place[labels == other].double() for other in sets)
        distance, index = (t[:, 0] for t in nearest_neighbours(theirs, 1, mine))
        best = distance <= NEXT * distance.amin()
        at = 0.5 * (mine[best] + theirs[index[best]]).mean(0)
        members = []
        for other in sets:
            own = (of == other).nonzero()[:, 0]
            far = (position[own].double() - at).norm(dim=-1)
            near = far.argsort(stable=True)[: max(LEAST, int((far < REACH * dx).sum()))]
            members.append(own[near])
        stiffness = math.inf if part.joint_stiffness is None else part.joint_stiffness
        found.append(PointJoint(members[0], members[1], at.tolist(), stiffness, part.joint_turning or 0.0))
    return tuple(found)
