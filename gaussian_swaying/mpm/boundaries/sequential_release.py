"""A part of the material that is held and released gradually."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion


class SequentialRelease(PinnedRegion):
    """Holds the particles of a region and releases them one after the other, as a front passes over them.

    Args:
        region: Region of the held particles at rest, in scene units.
        direction: Direction in which the front travels, in scene axes.
        start: Time at which the front meets the first particle [s]; before that, all are held.
        end: Time at which it passes the last one [s].
        kind: ``hinge``, ``clamp``, ``nodes`` or None, as for a :class:`PinnedRegion`. Held points are released when the
            front passes them.
        held_share: Share of the nodal mass for ``nodes`` in ``total``, between 0 and 1.
        first: Point that the front meets at ``start``, in scene units, instead of the first particle.
        last: Point that it passes at ``end``, in scene units, instead of the last particle; must be given together with
            ``first`` and lie farther along ``direction``.
    """

    def __init__(
        self,
        region: Region,
        direction: Sequence[float] = (0.0, 0.0, 1.0),
        start: float = 0.0,
        end: float = 1.0,
        kind: str | None = None,
        held_share: float = 0.07,
        first: Sequence[float] | None = None,
        last: Sequence[float] | None = None,
    ) -> None:
        super().__init__(region, kind, held_share=held_share, start=start, end=end)
        if not math.isfinite(self.end):
            raise ValueError(f"Expected `end` of the SequentialRelease to be a finite time, but got {end}.")
        if not any(check_vector("direction", direction)):
            raise ValueError("Expected `direction` of the SequentialRelease not to be zero.")
        self.register_buffer("direction", torch.tensor([float(c) for c in direction], dtype=torch.float64))
        self.direction: Tensor
        if (first is None) != (last is None):
            raise ValueError("Give both `first` and `last` of the SequentialRelease, or neither.")
        ends = None
        if first is not None and last is not None:
            ends = torch.tensor([check_vector("first", first), check_vector("last", last)], dtype=torch.float64)
            if not float((ends[1] - ends[0]) @ self.direction) > 0:
                raise ValueError(
                    f"Expected `last` of the SequentialRelease to be farther along `direction` than `first`, but got "
                    f"{list(last)} and {list(first)}."
                )
        self.register_buffer("ends", ends)  # first and last, shape (2, 3)
        self.ends: Tensor | None

    def in_frame(self, frame: SimFrame) -> SequentialRelease:
        """The release with its region, direction and points in metres, z up."""
        tensors = {"direction": frame.direction_to_sim(self.direction).clone()}
        if self.ends is not None:
            tensors["ends"] = frame.point_to_sim(self.ends)
        return self.copy_in(frame, **tensors)

    @property
    def holds_from(self) -> float:
        return -math.inf

    def active(self, time: Tensor) -> Tensor:
        """Always: particles are released one by one instead."""
        return time > -math.inf

    def release_time(self, rest_position: Tensor) -> Tensor:
        """When the front passes each particle [s], shape (..., P), float64."""
        mask = self.region.contains(rest_position)
        place = in_double(rest_position)
        mask = mask.to(place.device)
        along = (place * self.direction.to(place.device)).sum(-1)
        if self.ends is None:
            low = along.where(mask, math.inf).amin(-1, keepdim=True)
            high = along.where(mask, -math.inf).amax(-1, keepdim=True)
        else:
            low, high = (self.ends.to(along) @ self.direction.to(along)).unbind()
        part = (along - low) / (high - low).clamp(min=torch.finfo(torch.float64).tiny)
        return self.start + part * (self.end - self.start)
