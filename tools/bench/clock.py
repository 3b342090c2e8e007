"""Time and memory of a call, and how failures are recorded."""

from __future__ import annotations

import gc
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

Row = dict[str, Any]


class Clock:
    """Marks in time; on a GPU they are events in its stream."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.marks: list[Any] = []
        self.wait()

    def wait(self) -> None:
        """Wait until the device has done everything."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def mark(self) -> None:
        """Set a mark."""
        if self.device.type == "cuda":
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self.marks.append(event)
        else:
            self.marks.append(time.perf_counter())

    def read(self) -> list[float]:
        """Milliseconds between consecutive marks."""
        self.wait()
        pairs = zip(self.marks, self.marks[1:], strict=False)
        return [a.elapsed_time(b) if self.device.type == "cuda" else 1e3 * (b - a) for a, b in pairs]


def spread(samples: list[float], share: float = 1.0) -> dict[str, float]:
    """Median and quartiles of times [ms], each multiplied by ``share``."""
    low, median, high = statistics.quantiles(samples, n=4) if len(samples) > 1 else samples * 3
    return {
        "median_ms": share * median,
        "quartile_low_ms": share * low,
        "quartile_high_ms": share * high,
        "repeats": len(samples),
    }


def timed(
    function: Callable[[], Any], device: torch.device, repeats: int, warm: int = 3, share: float = 1.0
) -> dict[str, float]:
    """Milliseconds of a call after warm-up, multiplied by ``share``: median and quartiles; on a GPU between events."""
    for _ in range(warm):
        function()
    samples = []
    for _ in range(repeats):
        clock = Clock(device)
        clock.mark()
        function()
        clock.mark()
        samples += clock.read()
    return spread(samples, share)


def copy_bandwidth(size: int, device: torch.device) -> Row:
    """Bytes per second of a copy within device memory, counting both reads and writes."""
    source = torch.rand(size // 4, device=device)
    target = torch.empty_like(source)
    took = timed(lambda: target.copy_(source), device, 20 if device.type == "cuda" else 7)
    return {"copy_bytes": size, "bytes_per_s": 2 * size / (1e-3 * took["median_ms"])} | took


def clear() -> None:
    """Free unused memory."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


_MEASURED = """
import json, resource, subprocess, sys, time
begin = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
seconds, used = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
peak = used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
row = {"seconds": seconds, "processor_s": used.ru_utime + used.ru_stime, "bytes": peak}
print(json.dumps(row | {"code": done.returncode, "told": done.stderr}))
"""
"""Runs a command from a small process: the peak of a process begins with the memory of the one that starts it."""


def command(words: list[str], folder: Path) -> Row:
    """Seconds, seconds of the processor and peak memory [bytes] of a command, its exit code, and what it told."""
    done = subprocess.run(
        [sys.executable, "-c", _MEASURED, *words], cwd=folder, capture_output=True, text=True, check=True
    )
    row: Row = json.loads(done.stdout)
    return row


def guarded(function: Callable[[], Row]) -> Row:
    """The result of the function, or ``failed`` with the reason, so that one failure does not stop the other cases."""
    try:
        return function()
    except Exception as error:
        full = isinstance(error, (torch.OutOfMemoryError, MemoryError)) or "can't allocate memory" in str(error)
        return {"failed": "out of memory" if full else f"{type(error).__name__}: {error}"}
    finally:
        clear()


def safely(function: Callable[..., Row], *arguments: Any, **options: Any) -> Callable[[], Row]:
    """A guarded call for later."""
    return partial(guarded, partial(function, *arguments, **options))


class Peak:
    """Peak memory of torch's allocator since the last start, minus what it held at first; None on a CPU."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        clear()
        self.before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
        self.start()

    def start(self) -> None:
        """Forget the peak so far."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)

    def read(self) -> int | None:
        """The peak [bytes]."""
        return torch.cuda.max_memory_allocated(self.device) - self.before if self.device.type == "cuda" else None
