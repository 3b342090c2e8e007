"""The classes that run the substeps of the formulations in Triton kernels."""

from __future__ import annotations

from gaussian_swaying.mpm.formulations.formulation import Formulation
from gaussian_swaying.mpm.triton.fused import Fused
from gaussian_swaying.mpm.triton.fused_updated import FusedUpdated
from gaussian_swaying.mpm.triton.total_adjoint import DifferentiableTotal

TWINS: dict[str, type[Fused]] = {"total": DifferentiableTotal, "updated": FusedUpdated}
"""By the name of the formulation."""


def why_not_kernels(bound: Formulation, interpret: bool) -> str | None:
    """Return the reason why the kernels cannot be used with a formulation and its material; None if they can.

    Args:
        bound: The formulation.
        interpret: Whether the interpreter of Triton will do, too.
    """
    twin = TWINS.get(bound.name)
    return f"the {bound.name} formulation has no kernels" if twin is None else twin.unsupported(bound, interpret)
