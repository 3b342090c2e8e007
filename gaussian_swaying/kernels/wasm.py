"""Writes noted launches of a CPU as one WebAssembly module and an image of the memory that it works in.

The kernels are translated again and compiled by LLVM for WebAssembly. Its object file is a module already, but for the
exports, so no linker is needed. The module imports ``env.__linear_memory``, which must hold the image, the global
``env.__stack_pointer`` that starts at :data:`START`, and functions of C's library such as ``env.sinf``.
"""

from __future__ import annotations

import bisect
import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from llvmlite import ir
from torch import Tensor

from gaussian_swaying.kernels import cpu
from gaussian_swaying.kernels.blocks import ADDRESS, TYPES, Block, Value
from gaussian_swaying.kernels.translator import Translator

LANES = 4
"""Lanes of a vector: note launches within ``launch.narrowed(LANES)``."""

START = 2**16
"""Where the image starts; below it are the constants of the code and the stack."""

_TARGET = "wasm32-unknown-unknown"
_FEATURES = "+simd128,+bulk-memory,+sign-ext,+nontrapping-fptoint"
_SIDE = 64  # bytes: tensors start at multiples of it


@dataclass(frozen=True)
class Image:
    """A program for a browser.

    Attributes:
        modules: WebAssembly modules, which export functions without arguments: one that multiplies
            and adds in one instruction (relaxed SIMD, where the larger of NaN and a number may be NaN), and one for
            browsers that cannot.
        memory: What the memory holds from :data:`START` on.
        places: First byte in the memory, and number of bytes, of each tensor that was asked for.
        place: The byte of the memory for an address of a tensor.
    """

    modules: tuple[bytes, bytes]
    memory: bytes
    places: dict[str, tuple[int, int]]
    place: Callable[[int], int]


class _Translator(Translator):
    """Translates for WebAssembly.

    It has no maximum of C's library, a call of which would leave the module, and loops of three are not unrolled, which
    halves the code.
    """

    unrolled = 2

    def extreme(self, which: str, x: Value, y: Value, nan: bool = False) -> Block:
        a, b = self.matched(x, y)
        if nan or not a.floating:
            return super().extreme(which, a, b, nan)
        found = self.where(self.compare(">" if which == "max" else "<", a, b), a, b)
        return self.where(self.compare("==", b, b), found, a)  # b is not NaN


def image(
    launches: Mapping[str, Sequence[cpu.Noted]], tensors: Mapping[str, Tensor], others: Sequence[cpu.Noted] = ()
) -> Image:
    """The module of some noted launches, and the memory as it is now.

    Args:
        tensors: Contiguous tensors whose places in the memory are wanted; launches may use them or not.
    """
    every = [*(one for made in launches.values() for one in made), *others]
    memory = _Memory([*(tensor for one in every for tensor in one.tensors), *tensors.values()])
    module = ir.Module()
    kernels: dict[Any, ir.Function] = {}
    module.triple, module.data_layout = _TARGET, str(_machine("").target_data)
    for name, made in launches.items():
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), []), name)
        builder = ir.IRBuilder(function.append_basic_block())
        for one in made:
            if one.key not in kernels:
                kernels[one.key] = _kernel(module, one, f"kernel {len(kernels)}")
            row = memory.add(_moved(one, memory))
            place = ir.Constant(TYPES["i32"], row).inttoptr(ADDRESS)
            builder.call(kernels[one.key], [place, TYPES["i64"](0), TYPES["i64"](one.programs)])
        builder.ret_void()
    text = str(module)
    fused, plain = (
        _with_exports(cpu._compiled(text, _machine(more)), tuple(launches)) for more in (",+relaxed-simd", "")
    )
    places = {name: (memory.place(tensor.data_ptr()), tensor.nbytes) for name, tensor in tensors.items()}
    return Image((fused, plain), bytes(memory.content), places, memory.place)


@cache
def _machine(more: str) -> Any:
    llvm = cpu._llvm()
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return cpu._machine_for(_TARGET, "generic", _FEATURES + more)


def _kernel(module: ir.Module, noted: cpu.Noted, name: str) -> ir.Function:
    translator = _Translator(noted.real)
    translator.module = module
    translator.kernel(noted.kernel, noted.constants, noted.kinds, name)
    function: ir.Function = module.get_global(name)
    function.attributes.add("noinline")
    return function


class _Memory:
    """Tensors at new places, where those that share numbers still do."""

    def __init__(self, tensors: list[Tensor]) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []
        for first, last in sorted({(one.data_ptr(), one.data_ptr() + one.nbytes) for one in tensors if one.numel()}):
            if self._ends and first < self._ends[-1]:
                self._ends[-1] = max(self._ends[-1], last)
            else:
                self._starts.append(first)
                self._ends.append(last)
        self.content = bytearray()
        parts = zip(self._starts, self._ends, strict=True)
        self._places = [self.add(ctypes.string_at(first, last - first)) for first, last in parts]

    def add(self, values: bytes) -> int:
        self.content.extend(bytes(-len(self.content) % _SIDE))
        place = START + len(self.content)
        self.content.extend(values)
        return place

    def place(self, address: int) -> int:
        """The new place of an address; that of nothing is 0."""
        k = bisect.bisect_right(self._starts, address) - 1
        return self._places[k] + address - self._starts[k] if k >= 0 and address < self._ends[k] else 0


def _moved(noted: cpu.Noted, memory: _Memory) -> bytes:
    made = type(noted.arguments)(*noted.arguments)
    for k, kind in enumerate(noted.kinds.values(), 3):
        if kind[0] == "*":
            made[k] = memory.place(made[k])
    return bytes(made)


# ---- an object file of LLVM as a module

_CUSTOM, _EXPORT = 0, 7
_SYMBOLS, _FUNCTION, _DATA, _SECTION = 8, 0, 1, 3
_DEFINED_ELSEWHERE, _OWN_NAME = 0x10, 0x40


def _with_exports(code: bytes, names: tuple[str, ...]) -> bytes:
    sections = list(_sections(code, 8))
    linking = next(content for kind, content in sections if kind == _CUSTOM and content.startswith(b"\x07linking"))
    numbers = dict(_functions(linking))
    exports = _number(len(names))
    for name in names:
        exports += _number(len(name)) + name.encode() + b"\0" + _number(numbers[name])
    before = [(kind, content) for kind, content in sections if 0 < kind < _EXPORT]
    after = [(kind, content) for kind, content in sections if kind > _EXPORT]
    parts = [*before, (_EXPORT, exports), *after]
    return code[:8] + b"".join(bytes([kind]) + _number(len(content)) + content for kind, content in parts)


def _sections(code: bytes, at: int) -> Iterator[tuple[int, bytes]]:
    while at < len(code):
        size, start = _read(code, at + 1)
        yield code[at], code[start : start + size]
        at = start + size


def _functions(linking: bytes) -> Iterator[tuple[str, int]]:
    symbols = next(content for kind, content in _sections(linking, 9) if kind == _SYMBOLS)
    count, at = _read(symbols, 0)
    for _ in range(count):
        kind = symbols[at]
        flags, at = _read(symbols, at + 1)
        number, name = 0, ""
        if kind != _DATA:
            number, at = _read(symbols, at)
        if kind != _SECTION and (kind == _DATA or not flags & _DEFINED_ELSEWHERE or flags & _OWN_NAME):
            size, at = _read(symbols, at)
            name, at = symbols[at : at + size].decode(), at + size
        if kind == _DATA and not flags & _DEFINED_ELSEWHERE:  # segment, offset and size
            for _ in range(3):
                _, at = _read(symbols, at)
        if kind == _FUNCTION:
            yield name, number


def _read(code: bytes, at: int) -> tuple[int, int]:
    """A number in LEB128, and the place behind it."""
    value = shift = 0
    while code[at] & 128:
        value |= (code[at] & 127) << shift
        at, shift = at + 1, shift + 7
    return value | code[at] << shift, at + 1


def _number(value: int) -> bytes:
    made = b""
    while value > 127:
        made += bytes([value & 127 | 128])
        value >>= 7
    return made + bytes([value])
