"""Recording launches, as CUDA graphs or lists for a CPU."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import nn

from gaussian_swaying._fixed import Fixed
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.kernels.launch import call

RECORDED = 200_000
"""Most particles or Gaussians for which the kernels of their fields are recorded: CUDA graphs keep their memory."""

_RECORDING = threading.Lock()
"""Held while a graph is recorded: PyTorch cannot give memory back to the driver during that time."""


class Component(Fixed):
    """Base of modules that may be recorded in a CUDA graph, or have a device function.

    A subclass inherits neither, because it may compute something else: one with its own ``forward`` sets ``recordable``
    itself, and one that computes the same says ``device_function = Base.device_function``.

    Attributes:
        recordable: Whether ``forward`` can be recorded, and replayed at other times and substeps. For this it must
            depend only on its arguments and on numbers and buffers of the module, must never make the host wait, and
            must copy nothing to or from the host after the first call.
    """

    recordable = False

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "forward" in vars(cls):
            cls.recordable = vars(cls).get("recordable", False)
        if "device_function" not in vars(cls):
            cls.device_function = Component.device_function  # type: ignore[method-assign]

    def device_function(self) -> Any:
        """The ``DeviceFunction``, with numbers read lazily; None if the component runs in torch only."""
        return None

    def nearest_device_function(self) -> Any:
        own = (vars(kind).get("device_function", Component.device_function) for kind in type(self).__mro__)
        return next((one for one in own if one is not Component.device_function), Component.device_function)(self)


def recorded_key(modules: Sequence[nn.Module]) -> tuple[object, ...]:
    """Key of a recording of modules; it changes with their objects, tensor addresses and settings.

    What is in the tensors is read at each replay. An assignment to a module that is no ``Fixed`` is not detected, nor
    one within another object.
    """
    changes = (vars(part).get("_changed", 0) for part in _parts(modules))
    return (*modules, *changes, *((tensor.data_ptr(), tensor.shape) for tensor in tensors_in(modules)))


def tensors_in(modules: Iterable[nn.Module]) -> list[torch.Tensor]:
    """All parameters and buffers of modules, many times faster than ``parameters()`` and ``buffers()``."""
    held = ((vars(part)["_parameters"], vars(part)["_buffers"]) for part in _parts(modules))
    return [tensor for pair in held for own in pair for tensor in own.values() if tensor is not None]


def _parts(modules: Iterable[nn.Module]) -> Iterator[nn.Module]:
    for module in modules:
        yield module
        yield from _parts(child for child in vars(module)["_modules"].values() if child is not None)


class Replayed:
    """Calls a function of tensors; from the second consecutive call with the same key on, replays a CUDA graph.

    Many small kernels take longer to start than to run. Only the last recording is kept.
    """

    def __init__(self) -> None:
        self._key: Hashable = None
        self._repeater: Repeater | None = None
        self._inputs: list[torch.Tensor] = []
        self._outputs: list[torch.Tensor] = []

    def __getstate__(self) -> dict[str, object]:
        """The state without a graph, which cannot be copied."""
        return vars(Replayed())

    def __call__(
        self, key: Hashable, function: Callable[..., Sequence[torch.Tensor]], *inputs: torch.Tensor
    ) -> list[torch.Tensor]:
        """The results of the function, as new tensors.

        Args:
            key: Identifies all else that the function depends on, besides its inputs.
            function: Takes the inputs and returns tensors; it must not make the host wait.
            inputs: All on one device; if that is no GPU, nothing is recorded.
        """
        if not inputs[0].is_cuda or torch.is_grad_enabled():
            return list(function(*inputs))
        whole = (key, *((tensor.shape, tensor.dtype) for tensor in inputs))
        if self._repeater is None or whole != self._key:
            self._key, self._repeater = whole, Repeater(inputs[0].device)
            with torch.inference_mode(False), torch.no_grad():
                self._inputs = [tensor.clone() for tensor in inputs]

        def work(_: int) -> None:
            self._outputs = list(function(*self._inputs))

        torch._foreach_copy_(self._inputs, list(inputs))
        self._repeater.run(1, whole, work)
        return [tensor.clone() for tensor in self._outputs]


class Repeater:
    """Repeats pieces of work by replaying recordings of 16, 4 and 1 repetitions: CUDA graphs that share a memory pool.

    On a CPU they are lists of launches (``cpu.Recording``), also of 64 repetitions.

    The pool belongs to the graphs in use. Once all of them are dropped, its memory is freed before the next graph is
    recorded.

    Args:
        device: Device on which the work runs.
        kept: Number of pieces of work whose graphs are kept; those that ran longest ago are dropped.
    """

    SIZES = (16, 4, 1)

    def __init__(self, device: torch.device, kept: int = 4) -> None:
        self.device, self.kept = device, kept
        self._graphs: dict[Hashable, dict[int, Any]] = {}
        self._stream: torch.cuda.Stream | None = None

    def run(
        self,
        times: int,
        key: Hashable,
        work: Callable[[int], None],
        recordable: bool = True,
        launches: bool = False,
        counter: torch.Tensor | None = None,
    ) -> None:
        """Run the work ``times`` times.

        On a GPU the work runs without recording the first time a key is used, so that all its kernels are compiled.
        After that it is recorded and replayed. On a CPU it is recorded while it runs for the first time.

        Args:
            work: Runs it once; its argument is how often it ran since ``counter`` changed.
            launches: Whether it consists of launches of kernels, and of calls by ``kernels.launch.call``; only then is
                it recorded on a CPU.
            counter: A whole number on the device that is to grow by one each time.
        """
        if times == 0:  # nothing runs, so nothing is compiled
            return

        def several(count: int) -> None:
            for offset in range(count):
                work(offset)
            if counter is not None:
                call(lambda: counter.add_(count), self.device)

        if self.device.type == "cpu" and launches and not INTERPRETED:
            self._run_on_cpu(times, key, several)
            return
        if self.device.type != "cuda" or not recordable or key not in self._graphs:
            self.forget(key)
            while len(self._graphs) >= self.kept:
                self.forget(next(iter(self._graphs)))
            self._graphs[key] = {}
            for _ in range(times):
                several(1)
            return
        self._graphs[key] = graphs = self._graphs.pop(key)  # the newest now
        for size in self.SIZES:
            while times >= size:
                if size not in graphs:
                    graphs[size] = self._recorded(several, size)
                graphs[size].replay()
                times -= size

    def _run_on_cpu(self, times: int, key: Hashable, several: Callable[[int], None]) -> None:
        from gaussian_swaying.kernels.cpu import recording

        while key not in self._graphs and len(self._graphs) >= self.kept:
            self.forget(next(iter(self._graphs)))
        self._graphs[key] = graphs = self._graphs.pop(key, {})
        for size in (4 * self.SIZES[0], *self.SIZES):
            while times >= size:
                times -= size
                if size not in graphs:
                    with recording() as made:
                        several(size)
                    graphs[size] = made
                else:
                    graphs[size].replay()

    def _recorded(self, several: Callable[[int], None], size: int) -> torch.cuda.CUDAGraph:
        """Record what a function launches, without running it.

        All its kernels must have run before, so that nothing is compiled or loaded during the recording. It must not
        make the host wait. The tensors that it reads and writes must live as long as the graph. Graphs that share a
        pool also share the stream, since memory freed on one stream is not reused on another.
        """
        if self._stream is None:
            self._stream = torch.cuda.Stream(self.device)
        graph, stream = torch.cuda.CUDAGraph(), self._stream
        alive = next((graph for graphs in self._graphs.values() for graph in graphs.values()), None)
        with _RECORDING:
            if alive is None:
                # memory of dropped graphs and cached memory cannot be used during a recording; after a failed recording
                # PyTorch refuses to give it back
                with suppress(RuntimeError):
                    torch.cuda.synchronize(self.device)  # the dropped graphs may still be running
                    torch.cuda.empty_cache()
            stream.wait_stream(torch.cuda.current_stream(self.device))
            collecting = gc.isenabled()
            gc.disable()  # freeing another graph during the recording would break it
            try:
                # tensors that all graphs share get the mode of the first recording; if that was inference mode, they
                # could not be written outside it; other threads, such as the recorder's, may continue
                with torch.cuda.stream(stream), torch.inference_mode(False), torch.no_grad():
                    graph.capture_begin(None if alive is None else alive.pool(), capture_error_mode="thread_local")
                    try:
                        several(size)
                    except BaseException:
                        with suppress(RuntimeError):  # the original error matters more
                            graph.capture_end()
                        graph.reset()  # the traceback keeps the graph alive, which would keep its memory
                        raise
                    graph.capture_end()
            except RuntimeError as error:
                what = str(error).strip().split("\n")[0].split(" GPU ")[0].rstrip(".")
                if "out of memory" in what:
                    raise torch.OutOfMemoryError(
                        f"The GPU has no memory left to record a substep on a grid of this size ({what}): stop "
                        "particles that fly away with a Wall, or raise `solver.dx`."
                    ) from error
                if "captur" not in str(error):  # not a problem of the recording
                    raise
                raise RuntimeError(
                    f"A substep cannot be recorded in a CUDA graph ({what}): set `recordable` to False on the boundary "
                    "or force that makes the host wait, or set `transfer` to torch."
                ) from error
            finally:
                if collecting:
                    gc.enable()
        torch.cuda.current_stream(self.device).wait_stream(stream)
        return graph

    def forget(self, key: Hashable | None = None) -> None:
        for known in list(self._graphs) if key is None else [key]:
            for graph in self._graphs.pop(known, {}).values():
                graph.reset()
