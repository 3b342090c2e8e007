"""Compiles kernels for this processor, keeps them on disk, and runs their programs in threads.

A launch runs all programs of a kernel; the threads take equal shares of them and wait for each other at its end, so a
launch sees what the one before has written. A program does not depend on the others unless it says so by an atomic
operation, so the results do not depend on the number of threads.
"""

from __future__ import annotations

import ctypes
import hashlib
import itertools
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._files import atomic, cache_folder

_KINDS = {
    torch.float32: "*f32", torch.float64: "*f64", torch.int32: "*i32", torch.int64: "*i64", torch.int8: "*i8",
    torch.bool: "*i1",
}  # fmt: skip

_ROW = 6
"""Entries of a launch in a recording: address of the kernel, of its arguments, number of its programs, number of shares
into which they are cut, shares that a thread has taken, and shares that are done."""

# Runs the launches of a recording in one of several threads. Each takes the next share of a launch until there is none,
# and waits until all shares are done; a thread that the system lets wait delays the others by its one share at most.
_RUN = """
define void @run(ptr %rows, i64 %launches, ptr %pause) {
start:
  br label %launch
launch:
  %k = phi i64 [0, %start], [%following, %done]
  %more = icmp slt i64 %k, %launches
  br i1 %more, label %read, label %end
read:
  %at = mul i64 %k, 6
  %row = getelementptr i64, ptr %rows, i64 %at
  %arguments.at = getelementptr i64, ptr %row, i64 1
  %programs.at = getelementptr i64, ptr %row, i64 2
  %shares.at = getelementptr i64, ptr %row, i64 3
  %taken.at = getelementptr i64, ptr %row, i64 4
  %done.at = getelementptr i64, ptr %row, i64 5
  %kernel = load ptr, ptr %row
  %arguments = load ptr, ptr %arguments.at
  %programs = load i64, ptr %programs.at
  %shares = load i64, ptr %shares.at
  br label %take
take:
  %share = atomicrmw add ptr %taken.at, i64 1 acq_rel
  %left = icmp slt i64 %share, %shares
  br i1 %left, label %work, label %wait
work:
  %next = add i64 %share, 1
  %a = mul i64 %programs, %share
  %first = sdiv i64 %a, %shares
  %b = mul i64 %programs, %next
  %last = sdiv i64 %b, %shares
  call void %kernel(ptr %arguments, i64 %first, i64 %last)
  %before = atomicrmw add ptr %done.at, i64 1 acq_rel
  br label %take
wait:
  %spins = phi i64 [1, %take], [%spun, %again]
  %finished = load atomic i64, ptr %done.at acquire, align 8
  %all = icmp sge i64 %finished, %shares
  br i1 %all, label %done, label %rest
rest:
  %spun = add i64 %spins, 1
  %few = and i64 %spun, 255
  %long = icmp eq i64 %few, 0
  br i1 %long, label %yield, label %again
yield:
  %ignored = call i32 %pause()
  br label %again
again:
  br label %wait
done:
  %following = add i64 %k, 1
  br label %launch
end:
  ret void
}
"""


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@cache
def _machine() -> Any:
    llvm = _llvm()
    return _machine_for(llvm.get_default_triple(), llvm.get_host_cpu_name(), _features())


def _machine_for(triple: str, processor: str, features: str = "") -> Any:
    """The code generator of a processor.

    Addresses in its code reach any place: the parts of an object may lie farther apart in memory than the 32 bits that
    x86-64 has for them otherwise, and then LLVM would end the process. On arm64, LLVM does so for any code that it
    links in memory.
    """
    target = _llvm().Target.from_triple(triple)
    far = {"reloc": "static", "codemodel": "large"} if target.name == "x86-64" else {"codemodel": "jitdefault"}
    return target.create_target_machine(cpu=processor, features=features, opt=3, **far)


@cache
def _features() -> str:
    try:
        return str(_llvm().get_host_cpu_features().flatten())
    except RuntimeError:  # LLVM cannot tell: the name of the processor has to do
        return ""


@cache
def _linker() -> Any:
    return _llvm().create_lljit_compiler()


def _compiled(text: str, machine: Any = None) -> bytes:
    llvm, machine = _llvm(), machine or _machine()
    module = llvm.parse_assembly(text)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization = options.slp_vectorization = False  # blocks are vectors already
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return bytes(machine.emit_object(module))


def _linked(code: bytes, symbol: str) -> tuple[int, Any]:
    llvm = _llvm()
    name = f"kernel{next(_NAMES)}"  # never one that was tried before
    library = llvm.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol(symbol)
    tracker = library.link(_linker(), name)
    _LINKED.append(tracker)
    return tracker[symbol], tracker


_LINKED: list[Any] = []
_NAMES = itertools.count()
_COMPILED: dict[Any, int] = {}
_COMPILING = threading.RLock()
_spent = [0, 0.0, 0.0]
"""Kernels compiled, and the wall-clock and processor time that it took [s]."""


def _address(kernel: Any, constants: dict[str, Any], kinds: dict[str, str], real: str) -> int:
    key = (kernel, tuple(constants.items()), tuple(kinds.values()), real)
    address = _COMPILED.get(key)
    if address is None:
        with _COMPILING:
            address = _COMPILED.get(key)
            if address is None:
                address = _COMPILED[key] = _found_or_compiled(kernel, constants, kinds, real)
    return address


def _found_or_compiled(kernel: Any, constants: dict[str, Any], kinds: dict[str, str], real: str) -> int:
    from llvmlite import __version__

    options = sorted((name, str(getattr(value, "cache_key", "")), repr(value)) for name, value in constants.items())
    parts = (
        _sources(), device_source(kernel), options, kinds, real,
        __version__, _llvm().llvm_version_info, _llvm().get_host_cpu_name(), _features(),
    )  # fmt: skip
    path = cache_folder() / f"{kernel.fn.__name__}_{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.o"
    try:
        return _linked(path.read_bytes(), "kernel")[0]
    except (OSError, RuntimeError):  # it is not there, or broken
        pass
    from gaussian_swaying.kernels.translator import translate

    began, busy = time.perf_counter(), time.process_time()
    code = _compiled(str(translate(kernel, constants, kinds, real)))
    _spent[0] += 1
    _spent[1] += time.perf_counter() - began
    _spent[2] += time.process_time() - busy
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic(path) as temporary:
            temporary.write_bytes(code)
    except OSError:  # a read-only home folder: it is compiled again next time
        pass
    return _linked(code, "kernel")[0]


def compiled() -> tuple[int, float, float]:
    """Number of kernels compiled by this process for the CPU, with wall-clock and processor time [s]."""
    return int(_spent[0]), _spent[1], _spent[2]


def compiled_sentence(before: int) -> str | None:
    """A sentence about the kernels compiled after the first ``before``; None if there were none."""
    count, seconds, _ = compiled()
    if count <= before:
        return None
    kernels = "1 kernel" if count == 1 else f"{count} kernels"
    return f"Compiled {kernels} for this CPU in {seconds:.1f} s, once (kept in {cache_folder()})."


@cache
def _sources() -> str:
    """Changes with the source of what translates kernels; that of a kernel is in its own key."""
    paths = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def device_source(function: Any) -> str:
    """A key that changes with the source of a kernel or of a device function."""
    return str(getattr(function, "cache_key", "")) + f"{function.fn.__module__}.{function.fn.__qualname__}"


# ---- threads


class _Crew:
    """Threads that run a recording together with the thread that calls; they sleep in between."""

    def __init__(self, threads: int) -> None:
        address, _ = _linked(_compiled(_RUN), "run")
        self._run = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(address)
        self.threads = threads
        self._begin = [threading.Semaphore(0) for _ in range(threads - 1)]
        self._done = threading.Semaphore(0)
        self._job = (0, 0, 0)
        for k in range(threads - 1):
            threading.Thread(target=self._work, args=(k,), daemon=True, name=f"kernels-{k + 1}").start()

    def _work(self, k: int) -> None:
        while True:
            self._begin[k].acquire()
            self._run(*self._job)
            self._done.release()

    def run(self, rows: Any, launches: int) -> None:
        for k in range(launches):
            rows[_ROW * k + 3] = 1 if self.threads == 1 else min(rows[_ROW * k + 2], _SHARES * self.threads)
            rows[_ROW * k + 4] = rows[_ROW * k + 5] = 0
        self._job = ctypes.addressof(rows), launches, _pause()
        for semaphore in self._begin:
            semaphore.release()
        self._run(*self._job)
        for _ in self._begin:
            self._done.acquire()


_SHARES = 4
"""Shares of a launch for each thread."""


@cache
def _pause() -> int:
    if os.name == "nt":
        return ctypes.cast(ctypes.windll.kernel32.SwitchToThread, ctypes.c_void_p).value or 0  # type: ignore[attr-defined]
    return ctypes.cast(ctypes.CDLL(None).sched_yield, ctypes.c_void_p).value or 0


@lru_cache(maxsize=8)
def _crew(threads: int, process: int) -> _Crew:
    return _Crew(threads)


_RUNNING = threading.Lock()


def threads() -> int:
    """Number of threads that run kernels: that of torch."""
    return torch.get_num_threads()


def _run_rows(rows: Any, launches: int) -> None:
    with _RUNNING:
        _crew(threads(), os.getpid()).run(rows, launches)


# ---- launches


class Recording:
    """Launches, and functions between them, to run again. The tensors must stay where they are."""

    def __init__(self) -> None:
        self.parts: list[list[tuple[int, Any, int]] | Callable[[], object]] = []
        """Launches in a row (address of the kernel, arguments, number of programs), and functions between them."""
        self.held: list[tuple[Any, Sequence[Tensor]]] = []
        """The arguments of each launch, and the tensors that they refer to."""
        self._rows: dict[int, Any] = {}

    def add(self, address: int, arguments: Any, programs: int, tensors: Sequence[Tensor]) -> None:
        if not self.parts or not isinstance(self.parts[-1], list):
            self.parts.append([])
        self.parts[-1].append((address, arguments, programs))  # type: ignore[union-attr]
        self.held.append((arguments, tensors))

    def call(self, change: Callable[[], object]) -> None:
        self.parts.append(change)

    def replay(self) -> None:
        for k, part in enumerate(self.parts):
            if not isinstance(part, list):
                part()
                continue
            if k not in self._rows:
                words = [word for address, arguments, programs in part
                         for word in (address, ctypes.addressof(arguments), programs, 0, 0, 0)]  # fmt: skip
                self._rows[k] = (ctypes.c_int64 * len(words))(*words)
            _run_rows(self._rows[k], len(part))

    def reset(self) -> None:
        self.parts, self.held, self._rows = [], [], {}


@dataclass(frozen=True)
class Noted:
    """A noted launch: its compile key, grid, arguments as 8-byte words, and tensors."""

    kernel: Any
    constants: dict[str, Any]
    kinds: dict[str, str]
    real: str
    arguments: Any
    tensors: Sequence[Tensor]

    @property
    def key(self) -> Any:
        return self.kernel, tuple(self.constants.items()), tuple(self.kinds.values()), self.real

    @property
    def programs(self) -> int:
        return int(math.prod(self.arguments[:3]))


class _Current(threading.local):
    recording: Recording | None = None
    notes: list[Noted] | None = None


_current = _Current()


@contextmanager
def recording() -> Iterator[Recording]:
    """Within the block, record launches of this thread and functions passed to :func:`call`, while they run."""
    outer, made = _current.recording, Recording()
    _current.recording = made
    try:
        yield made
    finally:
        _current.recording = outer


@contextmanager
def noted() -> Iterator[list[Noted]]:
    """Within the block, note launches of this thread without running them; functions of :func:`call` are skipped."""
    made: list[Noted] = []
    _current.notes = made
    try:
        yield made
    finally:
        _current.notes = None


def call(change: Callable[[], object]) -> None:
    """Call a function between launches, and add it to a recording if there is one."""
    if _current.notes is not None:
        return
    change()
    if _current.recording is not None:
        _current.recording.call(change)


@lru_cache(maxsize=512)
def _parameters(kernel: Any) -> tuple[tuple[str, ...], frozenset[str]]:
    from gaussian_swaying.kernels.translator import _source

    _, names, _, constant = _source(kernel)
    return tuple(names), frozenset(constant)


_GPU_ONLY = ("num_warps", "maxnreg", "launch_cooperative_grid", "num_stages")


def launch(kernel: Any, grid: Sequence[int], *given: Any, **named: Any) -> None:
    """Run the programs of a kernel on the CPU, or record them.

    Its real numbers are of double precision if it gets tensors of them and none of single precision.

    Args:
        named: Its other arguments; those that only a GPU needs are ignored.
    """
    names, constant = _parameters(kernel)
    values = dict(zip(names, given, strict=False)) | {k: v for k, v in named.items() if k not in _GPU_ONLY}
    constants = {name: value for name, value in values.items() if name in constant}
    passed = {name: values[name] for name in names if name in values and name not in constant}
    kinds, words, tensors = {}, [], []
    types = {value.dtype for value in passed.values() if isinstance(value, Tensor)}
    real = "f64" if torch.float64 in types and torch.float32 not in types else "f32"
    for name, value in passed.items():
        if isinstance(value, Tensor):
            kinds[name] = _KINDS[value.dtype]
            words.append(value.data_ptr())
            tensors.append(value)
        elif isinstance(value, float):
            kinds[name] = "f"
            words.append(ctypes.c_int64.from_buffer(ctypes.c_double(value)).value)
        else:
            kinds[name] = "i" if -(2**31) <= value < 2**31 else "l"
            words.append(int(value))
    axes = (*grid, 1, 1)[:3]
    programs = axes[0] * axes[1] * axes[2]
    if programs == 0:
        return
    arguments = (ctypes.c_int64 * (3 + len(words)))(*axes, *words)
    if _current.notes is not None:
        _current.notes.append(Noted(kernel, constants, kinds, real, arguments, tensors))
        return
    address = _address(kernel, constants, kinds, real)
    if _current.recording is not None:
        _current.recording.add(address, arguments, programs, tensors)
    _run_rows((ctypes.c_int64 * _ROW)(address, ctypes.addressof(arguments), programs, 0, 0, 0), 1)
