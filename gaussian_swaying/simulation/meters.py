"""Measures what a run costs: seconds for each part, and memory."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from gaussian_swaying._provenance import peak_memory


class WallClock:
    """Seconds spent in each part of the run.

    Startup: on a GPU, a first frame that is thrown away, which loads and compiles the kernels. Simulation, shading and
        rendering: from start to end; on a GPU this is measured on its stream, so that the host need not wait, and as
        a frame is drawn while the next one is simulated, the parts may add up to more than the whole. Writing: the time
        that the main thread spends in the recorder, not the time of the recorder's own threads.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds = {"simulation": 0.0, "shading": 0.0, "rendering": 0.0, "writing": 0.0}
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Add the time of the block to a part."""
        if self.device.type == "cuda" and part != "writing":
            stream = torch.cuda.current_stream(self.device)
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            start.record(stream)
            try:
                yield
            finally:
                end.record(stream)
                self._events.append((part, start, end))
            return
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] += time.perf_counter() - begin

    def read(self, wait: bool = False) -> dict[str, float]:
        """The time of each part [s]; with ``wait`` also that of GPU work that is not finished yet."""
        if wait and self._events:
            self._events[-1][2].synchronize()
        while self._events and self._events[0][2].query():
            part, start, end = self._events.pop(0)
            self.seconds[part] = self.seconds.get(part, 0.0) + start.elapsed_time(end) / 1000
        return dict(self.seconds)


class PeakMemory:
    """Largest memory of the process and, on a GPU, of torch's allocator."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)

    def read(self) -> dict[str, int | None]:
        """Bytes of the process and of torch's allocator; None if unknown."""
        device = torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else None
        return {"host": peak_memory(), "device": device}
