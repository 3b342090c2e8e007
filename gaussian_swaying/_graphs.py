"""Recording of CUDA graphs, and whether a recorded one still holds."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Hashable, Iterable
from contextlib import suppress
from typing import Any

import torch
from torch import nn

_RECORDING = threading.Lock()
"""Held while a graph is recorded: PyTorch cannot give memory back to the driver meanwhile."""


class Recordable:
    """Base of modules of which some can be recorded in a CUDA graph.

    Attributes:
        recordable: Whether ``forward`` depends on nothing but its arguments, numbers and buffers of the module, never
            makes the host wait, and after a first call copies nothing from or to it, so that a graph may be replayed
            at other times and substeps. A class with a ``forward`` of its own has to say so itself.
    """

    recordable = False

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "forward" in vars(cls):
            cls.recordable = vars(cls).get("recordable", False)


def fingerprint(modules: Iterable[nn.Module]) -> tuple[tuple[object, ...], ...]:
    """What modules depend on besides the contents of their tensors: the same as long as none of it was replaced.

    Their types, numbers and strings, where their tensors lie and which objects they hold; what was changed within an
    object that is no module, a region say, is not seen.
    """
    plain = (bool, int, float, str, type(None))
    return tuple(
        (
            type(part),
            *(
                (name, value if isinstance(value, plain) else id(value))
                for name, value in vars(part).items()
                if not name.startswith("_")
            ),
            *((t.data_ptr(), t.shape) for t in (*part.parameters(recurse=False), *part.buffers(recurse=False))),
        )
        for module in modules
        for part in module.modules()
    )


def record(
    device: torch.device, work: Callable[[], Any], pool: Any = None, stream: torch.cuda.Stream | None = None
) -> torch.cuda.CUDAGraph:
    """Record what a function launches, without running it.

    Everything it launches must have run before, so that nothing is compiled or loaded meanwhile, and it must not make
    the host wait. What it reads and writes must live as long as the graph.

    Args:
        device: A CUDA device.
        work: The function.
        pool: Memory pool of what it allocates, shared by graphs of which no two run at once; one of its own if None.
        stream: Where it is recorded; a new one if None. Graphs that share a pool must share it too: memory that was
            freed on one stream is given to no other.

    Returns:
        The graph; ``replay()`` runs it.

    Raises:
        RuntimeError: If the function does what cannot be recorded.
    """
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(device) if stream is None else stream
    stream.wait_stream(torch.cuda.current_stream(device))
    with _RECORDING:
        collecting = gc.isenabled()
        gc.disable()  # a graph that is freed meanwhile would break the recording
        try:
            # numbers that all graphs share are tensors of the mode of the first, and could not be written outside
            # inference mode if that was it
            with torch.cuda.stream(stream), torch.inference_mode(False), torch.no_grad():
                # other threads, that of the recorder say, may go on
                graph.capture_begin(pool=pool, capture_error_mode="thread_local")
                try:
                    work()
                except BaseException:
                    with suppress(RuntimeError):  # what broke the recording matters more
                        graph.capture_end()
                    graph.reset()  # the traceback keeps it, and it would keep its memory
                    raise
                graph.capture_end()
        finally:
            if collecting:
                gc.enable()
    torch.cuda.current_stream(device).wait_stream(stream)
    return graph


class Repeater:
    """Repeats pieces of work from CUDA graphs of 16, 4 and 1 repetitions, which share one pool of memory.

    The pool is that of the graphs in use. Once they are all forgotten its memory is given back before the next one is
    recorded.

    Args:
        device: Where the work runs; without CUDA it just runs.
    """

    SIZES = (16, 4, 1)
    KEPT = 4
    """Pieces of work whose graphs are kept, the latest ones."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._graphs: dict[Hashable, dict[int, torch.cuda.CUDAGraph]] = {}
        self._stream: torch.cuda.Stream | None = None

    def run(self, times: int, key: Hashable, several: Callable[[int], None], recordable: bool = True) -> None:
        """Run the work ``times`` times.

        The first time a key is seen it runs as it is, which compiles what is not yet compiled; after that it is
        recorded.

        Args:
            times: How often.
            key: Names the work.
            several: ``several(n)`` runs it n times.
            recordable: Whether it may be recorded.

        Raises:
            RuntimeError: If it was said to be recordable and is not.
            torch.OutOfMemoryError: If there is no memory left to record it.
        """
        if times == 0:  # nothing runs, so nothing is compiled
            return
        if self.device.type != "cuda" or not recordable or key not in self._graphs:
            self.forget(key)
            while len(self._graphs) >= self.KEPT:
                self.forget(next(iter(self._graphs)))
            self._graphs[key] = {}
            for _ in range(times):
                several(1)
            return
        graphs = self._graphs[key]
        for size in self.SIZES:
            while times >= size:
                if size not in graphs:
                    graphs[size] = self._recorded(several, size)
                graphs[size].replay()
                times -= size

    def _recorded(self, several: Callable[[int], None], size: int) -> torch.cuda.CUDAGraph:
        if self._stream is None:
            self._stream = torch.cuda.Stream(self.device)
        alive = next((graph for graphs in self._graphs.values() for graph in graphs.values()), None)
        if alive is None:
            # what graphs that are gone have held, and what is cached, cannot be had while recording; PyTorch refuses to
            # give it back once a recording was broken off
            with _RECORDING, suppress(RuntimeError):
                torch.cuda.synchronize(self.device)  # they may still run
                torch.cuda.empty_cache()
        try:
            return record(self.device, lambda: several(size), None if alive is None else alive.pool(), self._stream)
        except RuntimeError as error:
            what = str(error).strip().split("\n")[0].split(" GPU ")[0].rstrip(".")
            if "out of memory" in what:
                raise torch.OutOfMemoryError(
                    f"No memory is left on the GPU to record a substep on a grid of this size ({what}): keep what "
                    "flies away within an EnclosingBox or behind a Plane, or coarsen `solver.dx`."
                ) from error
            if "captur" not in str(error):  # it is no matter of recording
                raise
            raise RuntimeError(
                f"A substep cannot be recorded in a CUDA graph ({what}): set `recordable` of the boundary or force "
                "that makes the host wait to False, or `transfer` to torch."
            ) from error

    def forget(self, key: Hashable | None = None) -> None:
        """Drop the graphs of one key, or all of them."""
        for known in list(self._graphs) if key is None else [key]:
            for graph in self._graphs.pop(known, {}).values():
                graph.reset()
