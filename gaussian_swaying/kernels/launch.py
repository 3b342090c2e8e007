"""Launches kernels on the device of their tensors."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels.language import INTERPRETED, Compiler, triton

LANES = 8
"""Lanes of a program on a CPU."""


@cache
def compiles(device: str) -> bool:
    """True if kernels can be compiled for a kind of device, ``cuda`` or ``cpu``."""
    if device == "cuda":
        return triton is not Compiler and not isinstance(triton, Compiler)
    return device == "cpu" and (INTERPRETED or importlib.util.find_spec("llvmlite") is not None)


def lanes(device: torch.device, gpu: int, cpu: int = LANES) -> int:
    """The size of a block: that for a GPU, or for a CPU, whose blocks have one axis that is longer than one."""
    return gpu if device.type == "cuda" or INTERPRETED else cpu


def launch(kernel: Any, grid: Sequence[int]) -> Callable[..., None]:
    """Return a function that runs the programs of a kernel, or records them if launches are being recorded.

    It takes the arguments of the kernel, of which tensors are contiguous and on one device, and options of Triton,
    which a CPU does not need.

    Args:
        kernel: The kernel.
        grid: Number of programs along each of up to three axes.
    """

    def run(*given: Any, **named: Any) -> None:
        device = next(value.device for value in given if isinstance(value, Tensor))
        if device.type == "cuda" or INTERPRETED:
            kernel[tuple(grid)](*given, **named)
            return
        from gaussian_swaying.kernels import cpu

        cpu.launch(kernel, grid, *given, **named)

    return run


def call(change: Callable[[], object], device: torch.device) -> None:
    """Call a function between launches on a device; where launches are recorded, it is called again with them."""
    if device.type == "cuda" or INTERPRETED:
        change()
        return
    from gaussian_swaying.kernels import cpu

    cpu.call(change)


__all__ = ["LANES", "call", "compiles", "lanes", "launch"]
