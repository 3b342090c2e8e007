"""Launches kernels on the device of their tensors."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels.language import INTERPRETED, Compiler, tl, triton

MAX_INDEX = 2**31
"""Number of entries of a buffer that kernels can address, with 32-bit indices."""

LANES = 8
"""Lanes of a program on a CPU, outside of :func:`narrowed`."""

_LANES: ContextVar[int] = ContextVar("lanes", default=LANES)


@triton.jit
def _trial(out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202  (Triton reads the types)
    tl.store(out, 1.0)


@cache
def compiles(device: str) -> bool:
    """True if kernels can be compiled for a kind of device, ``cuda`` or ``cpu``; tried once, on a small one."""
    if device == "cpu" and INTERPRETED:
        return True
    compiler = (
        not isinstance(triton, Compiler) if device == "cuda" else importlib.util.find_spec("llvmlite") is not None
    )
    if device not in ("cuda", "cpu") or not compiler:
        return False
    try:
        launch(_trial, (1,))(torch.empty(1, device=device))
    except Exception as error:  # for any error the torch functions give the same result
        warnings.warn(f"Kernels cannot be compiled for {device} ({error}): everything takes longer.", stacklevel=2)
        return False
    return True


def replaces(given: Iterable[Tensor], dtype: torch.dtype | None = torch.float32) -> bool:
    """True if a kernel without gradients may replace torch functions on these tensors.

    Triton's interpreter replaces nothing, as it takes far longer.

    Args:
        dtype: The only type that the kernel takes; None for any.
    """
    known = list(given)
    if any(dtype is not None and tensor.dtype != dtype for tensor in known) or INTERPRETED:
        return False
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in known)
    return not wanted and compiles(known[0].device.type)


def lanes(device: torch.device, gpu: int, cpu: int | None = None) -> int:
    """Block size for a device: ``gpu``, or ``cpu``, where blocks have one long axis."""
    return gpu if device.type == "cuda" or INTERPRETED else _LANES.get() if cpu is None else cpu


@contextmanager
def narrowed(count: int) -> Iterator[None]:
    """Within the block, programs that this thread launches on a CPU have ``count`` lanes."""
    token = _LANES.set(count)
    try:
        yield
    finally:
        _LANES.reset(token)


def wide(device: torch.device) -> bool:
    """True if the device adds four numbers atomically in one instruction (NVIDIA, from 9.0 on)."""
    return device.type == "cuda" and not INTERPRETED and torch.cuda.get_device_capability(device) >= (9, 0)


def launch(kernel: Any, grid: Sequence[int]) -> Callable[..., None]:
    """Return a function that runs the programs of a kernel, or records them if launches are being recorded.

    It takes the arguments of the kernel, of which tensors are contiguous and on one device, and options of Triton,
    which a CPU does not need.
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
    """Call a function between launches on a device; in a recording it becomes part of the replay."""
    if device.type == "cuda" or INTERPRETED:
        change()
        return
    from gaussian_swaying.kernels import cpu

    cpu.call(change)
