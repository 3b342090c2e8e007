"""A pull on points of the material towards a place, with a spring and a damper that stops it from swinging."""

from __future__ import annotations

import torch

from gaussian_swaying.geometry.linalg_triton import add3, axpy3, dot3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers

QUICK = 40.0
"""How quickly what is held follows, if nothing else acts on it [1/s]."""
STRONGEST = 400.0
"""Largest acceleration of what is held [m/s²]."""


@triton.jit
def pull_force(F, velocity, position, point, numbers, now, table, OPTIONS):
    """Force and damping of a pull, as a device function of a force.

    ``point``: where the point belongs from the place that ``now`` is [m], and the mass that is held [kg]. ``OPTIONS``:
    :data:`QUICK` and :data:`STRONGEST`.
    """
    away = add3(add3(now, 1.0, (point[0], point[1], point[2])), -1.0, position)
    wanted = OPTIONS[0] * OPTIONS[0] * tl.sqrt(dot3(away, away))
    pull = OPTIONS[0] * OPTIONS[0] * OPTIONS[1] / tl.maximum(wanted, OPTIONS[1])
    damping = 2 * OPTIONS[0] * point[3]
    return axpy3(point[3] * pull, away, -damping, velocity), damping


def still_pull(points: torch.Size) -> DeviceFunction:
    """A pull that holds nothing yet; ``points`` is the shape of a field of one number for each point."""
    return DeviceFunction(
        pull_force,
        options=(QUICK, STRONGEST),
        per_point=Numbers(4, lambda: torch.zeros(*points, 4)),
        per_substep=Numbers(3, lambda time, dt, steps: torch.zeros(steps, 3)),
        implicit=True,
    )
