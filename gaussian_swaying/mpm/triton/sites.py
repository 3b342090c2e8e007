"""Forces with twins on the sites of the ``modes`` formulation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.triton import site_kernels as kernels
from gaussian_swaying.mpm.twins import Loads, Twin


class SiteForces:
    """The buffers of the kernel of a body's sites.

    Args:
        rest: Places of the sites at rest [m], shape (..., S, 3).
    """

    def __init__(self, rest: Tensor) -> None:
        self.rest, self.sites = rest.contiguous(), rest.shape[-2]
        self.loads = Loads(rest.shape[:-1], {"dtype": rest.dtype, "device": rest.device})
        self.values = rest.new_zeros(1)

    def prepare(self, twins: Sequence[Twin], time: Tensor, dt: float, steps: int) -> None:
        """Take the numbers of the forces for some substeps.

        Args:
            twins: Those of forces on sites.
            time: Time at which the first one acts [s], scalar float64 tensor.
            dt: Substep [s].
            steps: Number of substeps.
        """
        values = self.loads.take(twins, steps)
        if values is not None:
            self.values = values.to(self.rest).T.contiguous()
        self.loads.begin(time, torch.full_like(time, dt), steps)

    def __call__(self, moved: Tensor, step: int) -> Tensor:
        """The forces in a substep: in the axes of a site and in space [N], and the resistance [kg/s].

        Args:
            moved: Displacements and turns of the sites, and their rates, shape (..., 6 S, 2).
            step: Number of the substep since :meth:`prepare`.

        Returns:
            Shape (..., S, 8), the last column unused.
        """
        loads, count, out = self.loads, self.rest.shape[:-1].numel(), moved.new_empty(*self.rest.shape[:-1], 8)
        block = lanes(moved.device, 128)
        with torch.cuda.device_of(out):
            launch(kernels.site_forces, (-(-count // block),))(
                moved.contiguous(), self.rest, self.values, loads.vectors, loads.tables.buffer, out, count, self.sites,
                loads.scenes, step, FORCES=loads.layout, BLOCK=block, num_warps=4,
            )  # fmt: skip
        return out
