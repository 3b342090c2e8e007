"""A pull on points of the material towards a place, with a spring and a damper that stops it from swinging."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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

    ``point``: offset of the point's target from the place ``now`` [m], and the pulled mass [kg]. ``OPTIONS``:
    :data:`QUICK` and :data:`STRONGEST`.
    """
    away = add3(add3(now, 1.0, (point[0], point[1], point[2])), -1.0, position)
    wanted = OPTIONS[0] * OPTIONS[0] * tl.sqrt(dot3(away, away))
    pull = OPTIONS[0] * OPTIONS[0] * OPTIONS[1] / tl.maximum(wanted, OPTIONS[1])
    damping = 2 * OPTIONS[0] * point[3]
    return axpy3(point[3] * pull, away, -damping, velocity), damping


def pull(per_point: Callable[[], torch.Tensor], place: Callable[..., torch.Tensor], **further: Any) -> DeviceFunction:
    """A pull of points towards a place that may move.

    Args:
        per_point: Returns the offset of each point's target from the place [m], and the pulled mass [kg], shape (...,
            P, 4).
        place: Returns the place [m] at the start of substeps, by time, substep and their number, shape (steps, 3).
    """
    own, now = Numbers(4, per_point), Numbers(3, place)
    options = (QUICK, STRONGEST)
    return DeviceFunction(pull_force, options, per_point=own, per_substep=now, implicit=True, **further)


def still_pull(points: torch.Size) -> DeviceFunction:
    """A pull that holds nothing yet; ``points`` is the shape (..., P)."""
    return pull(lambda: torch.zeros(*points, 4), lambda time, dt, steps: torch.zeros(steps, 3))
