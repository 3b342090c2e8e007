"""Measures of a state, in one kernel each, without the buffers of a substep."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.body import Body
from gaussian_swaying.mpm.formulations.formulation import Formulation
from gaussian_swaying.mpm.laws.triton.functions import shared
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.triton import measure_kernels as kernels


def largest_speed(bound: Formulation, state: MPMState) -> Tensor | None:
    """Cells per second as ``Formulation.cells_per_second``, in one kernel; None for laws with no common wave speed."""
    points, laws, spatial = bound.body.points, bound.body.laws, not bound.neighbours_fixed
    wave = shared(points.laws, "wave")
    if wave is None:
        return None
    out = points.position.new_zeros(1)
    count, block = points.mass.numel(), lanes(out.device, 128)
    density = points.mass / points.volume
    with torch.cuda.device_of(out):
        launch(kernels.largest_speed, (-(-count // block),))(
            state.F_elastic.contiguous(), density.contiguous(), laws.mu.contiguous(), laws.lam.contiguous(),
            state.velocity.contiguous(), out, count, WAVE=wave, SPATIAL=spatial, BLOCK=block, num_warps=4,
        )  # fmt: skip
    return out[0] / bound.settings.dx


def elastic_energy(body: Body, F: Tensor) -> Tensor | None:
    """Energy density [J/m³] in one kernel, shape (..., P); None for laws without a common energy."""
    energy = shared(body.points.laws, "energy")
    if energy is None:
        return None
    out = F.new_empty(F.shape[:-2])
    block = lanes(out.device, 128)
    with torch.cuda.device_of(out):
        launch(kernels.elastic_energy, (-(-out.numel() // block),))(
            F.contiguous(), body.laws.mu.contiguous(), body.laws.lam.contiguous(), out, out.numel(), ENERGY=energy,
            BLOCK=block, num_warps=4,
        )  # fmt: skip
    return out
