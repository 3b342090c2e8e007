"""Forces with twins on the sites of the ``modes`` formulation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.triton import site_kernels as kernels
from gaussian_swaying.mpm.twins import Composed, Tables, Twin, Watched


class SiteForces:
    """The buffers of the kernel of a body's sites.

    Args:
        rest: Places of the sites at rest [m], shape (..., S, 3).
    """

    def __init__(self, rest: Tensor) -> None:
        self.rest, self.sites = rest.contiguous(), rest.shape[-2]
        self.scenes = max(1, rest.shape[:-2].numel())
        self.forces, self.tables, self._watched = Composed(()), Tables(rest.device, rest.dtype), Watched()
        self.values = self.vectors = rest.new_zeros(1)

    def prepare(self, twins: Sequence[Twin], time: Tensor, dt: float, steps: int) -> None:
        """Take the numbers of the forces for some substeps.

        Args:
            twins: Those of forces on sites.
            time: Time at which the first one acts [s], scalar float64 tensor.
            dt: Substep [s].
            steps: Number of substeps.
        """
        before, self.forces = self.forces, Composed(twins)
        self.tables.take(twins, self.forces)
        if self._watched.changed([source for twin in twins for source in twin.sources]) or self.forces != before:
            shape = self.rest.shape[:-1]
            rows = [twin.per_point.take() for twin in twins if twin.per_point.count]
            columns = [row.expand(*shape, row.shape[-1]).flatten(0, -2) for row in rows]
            self.values = torch.cat(columns, -1).to(self.rest).T.contiguous() if columns else self.values
        width = self.forces.width
        self.vectors = self.rest.new_zeros(steps, self.scenes, width)
        step = torch.full_like(time, dt)
        places = zip(twins, self.forces.numbers, self.forces.per_substep, strict=True)
        for twin, (first, many), (start, count) in places:
            if many:
                self.tables.buffer[first : first + many].copy_(torch.as_tensor(twin.numbers.take()))
            if count:
                rows_of = torch.as_tensor(twin.per_substep.take(time, step, steps)).reshape(steps, -1, count)
                self.vectors[..., start : start + count].copy_(rows_of.expand(-1, self.scenes, -1))

    def __call__(self, moved: Tensor, step: int) -> Tensor:
        """The forces in a substep: in the axes of a site and in space [N], and the resistance [kg/s].

        Args:
            moved: Displacements and turns of the sites, and their rates, shape (..., 6 S, 2).
            step: Number of the substep since :meth:`prepare`.

        Returns:
            Shape (..., S, 8), the last column unused.
        """
        count, out = self.scenes * self.sites, moved.new_empty(*self.rest.shape[:-1], 8)
        block = lanes(moved.device, 128)
        with torch.cuda.device_of(out):
            launch(kernels.site_forces, (-(-count // block),))(
                moved.contiguous(), self.rest, self.values, self.vectors, self.tables.buffer, out, count, self.sites,
                self.scenes, step, FORCES=self.forces, BLOCK=block, num_warps=4,
            )  # fmt: skip
        return out
