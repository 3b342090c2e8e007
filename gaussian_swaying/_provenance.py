"""Device, cores, versions and memory of a run, recorded with its numbers."""

from __future__ import annotations

import os
import platform
import sys
from functools import cache

import torch

import gaussian_swaying


def describe_device(device: torch.device) -> str:
    """Name of the processor or GPU, with the number of threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.machine()} CPU, {torch.get_num_threads()} threads"


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory(device: torch.device) -> dict[str, int | None]:
    """Largest memory so far [bytes]: ``host`` of the process (None on Windows), ``device`` of torch's allocator."""
    on_device = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
    try:
        import resource
    except ImportError:
        return {"host": None, "device": on_device}
    unit = 1 if sys.platform == "darwin" else 1024
    return {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit, "device": on_device}


def versions() -> dict[str, str]:
    """Versions of the software that results depend on."""
    found = {"python": platform.python_version(), "gaussian_swaying": gaussian_swaying.__version__}
    return found | {name: _version(name) for name in ("torch", "gsplat", "numpy")}


@cache  # a process may write the numbers of hundreds of runs
def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
