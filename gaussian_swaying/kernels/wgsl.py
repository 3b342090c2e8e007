"""Writes noted launches as compute shaders in WGSL: a program of a kernel is an invocation, whose blocks have one lane.

The shaders of a module work on one buffer ``memory``, the image of :mod:`~gaussian_swaying.kernels.wasm`, whose first
byte is :data:`~gaussian_swaying.kernels.wasm.START`. All arguments are written into the code but ``step_offset``, which
is the uniform ``step``. A largest value that an atomic operation finds is in the buffer ``peaks``.
"""

from __future__ import annotations

import ast
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from gaussian_swaying.kernels import elementary
from gaussian_swaying.kernels.blocks import Block, Pointer, Shape, TranslationError, Value
from gaussian_swaying.kernels.cpu import Noted
from gaussian_swaying.kernels.translator import Scope, Translator, _assigned, _plain, _Returned, _Same

GROUP = 64
"""Programs of a workgroup."""

STEP = "step_offset"

_HEAD = """
@group(0) @binding(0) var<storage, read_write> memory: array<u32>;
@group(0) @binding(1) var<storage, read_write> peaks: array<atomic<u32>>;
@group(1) @binding(0) var<uniform> step: i32;
"""
_TYPES = {"i1": "bool", "i8": "i32", "i32": "i32", "i64": "i32", "f32": "f32"}
_FUNCTIONS = {"fabs": "abs"}
_LARGEST = 3.4028234e38  # stands for infinity, which WGSL does not have


def shaders(
    passes: Mapping[str, Sequence[Noted]], place: Callable[[int], int]
) -> tuple[str, dict[str, list[tuple[str, int]]]]:
    """A module of shaders, and for each pass the shaders that it runs in turn with their numbers of workgroups.

    Args:
        passes: Noted launches by the names of the passes; of blocks with one lane.

    Raises:
        TranslationError: If a kernel uses something that shaders do not have.
    """
    names: dict[str, str] = {}
    found = {}
    peaks: list[int] = []
    for key, launches in passes.items():
        found[key] = [
            (names.setdefault(_Shader(place, peaks).written(one), f"kernel_{len(names)}"), -(-one.programs // GROUP))
            for one in launches
        ]
    entry = f"@compute @workgroup_size({GROUP})\nfn {{}}(@builtin(global_invocation_id) id: vec3u) {{{{\n{{}}\n}}}}\n"
    return _HEAD + "".join(entry.format(name, text) for text, name in names.items()), found


class _Shader(Translator):
    """Writes statements in place of LLVM's instructions; the value of a block are the names of its lanes' numbers."""

    unrolled = 2

    def __init__(self, place: Callable[[int], int], peaks: list[int]) -> None:
        super().__init__("f32")
        self._where_is, self._peaks = place, peaks
        self._lines: list[str] = []
        self._count = 0

    def written(self, noted: Noted) -> str:
        if noted.real != "f32":
            raise TranslationError(f"{noted.kernel.__name__} computes in double precision")
        x, y, _, *words = noted.arguments
        scope: Scope = {name: _plain(value) for name, value in noted.constants.items()}
        for (name, what), word in zip(noted.kinds.items(), words, strict=True):
            if what[0] == "*":
                scope[name] = Pointer(self._where_is(word), what[1:], self.constant(0, "i32"))
            elif name == STEP:
                scope[name] = Block(("step",), "i32")
            else:
                number = struct.unpack("d", struct.pack("q", word))[0] if what == "f" else word
                scope[name] = self.constant(number, "f32" if what == "f" else "i32")
        self._grid = [self.constant(size, "i64") for size in noted.arguments[:3]]
        self._lines += ["let program = i32(id.x);", f"if (program >= {noted.programs}) {{ return; }}"]
        place = ["program", "0", "0"] if x == noted.programs else [f"program % {x}", f"program / {x} % {y}", "0"]
        self._program = [self._made_of("i32", (), [text]) for text in place]
        self._call(noted.kernel, (), scope, True)
        return "\n".join(self._lines)

    # ---- statements

    def _name(self) -> str:
        self._count += 1
        return f"t{self._count}"

    def _made_of(self, kind: str, shape: Shape, texts: Sequence[str]) -> Block:
        names = tuple(self._name() for _ in texts)
        self._lines += [f"let {name} = {text};" for name, text in zip(names, texts, strict=True)]
        return Block(names, kind, shape)

    def _variables(self, kind: Any) -> list[str]:
        texts: list[str] = []
        if isinstance(kind, tuple):
            for part in kind:
                texts += self._variables(part)
        elif hasattr(kind, "offset"):
            texts = self._variables(kind.offset)
        elif not isinstance(kind, _Same):
            texts = [self._name() for _ in range(math.prod(kind.shape))]
            self._lines += [f"var {name}: {_TYPES[kind.kind]};" for name in texts]
        return texts

    def _put(self, variables: list[str], value: Value) -> None:
        numbers = [number for leaf in self._leaves(value) for number in leaf.value]
        self._lines += [f"{name} = {number};" for name, number in zip(variables, numbers, strict=True)]

    def _got(self, variables: list[str], kind: Any) -> Value:
        names = iter(variables)

        def values(kind: Any) -> Any:
            if isinstance(kind, tuple):
                return [each for part in kind for each in values(part)]
            if isinstance(kind, _Same):
                return []
            own = getattr(kind, "offset", kind)
            return [self._made_of(own.kind, own.shape, [next(names) for _ in range(math.prod(own.shape))]).value]

        return self._made(kind, iter(values(kind)))

    def _if(self, node: ast.If, scope: Scope) -> _Returned | None:
        condition = self._eval(node.test, scope)
        if not isinstance(condition, Block):
            return self._run(node.body if condition else node.orelse, scope)
        chosen = self.convert(condition, "i1").value[0]
        outer, ends = self._lines, []
        for body in (node.body, node.orelse):
            self._lines, inner = [], dict(scope)
            if self._run(body, inner) is not None:
                raise TranslationError("cannot return under a condition that is not constant")
            ends.append((inner, self._lines))
        self._lines = outer
        names = sorted(_assigned(node.body) | _assigned(node.orelse))
        kinds = {
            name: self._join(*(own[name] for own, _ in ends)) for name in names if all(name in own for own, _ in ends)
        }
        places = {name: self._variables(kind) for name, kind in kinds.items()}
        for inner, self._lines in ends:
            for name, kind in kinds.items():
                self._put(places[name], self._fit(inner[name], kind))
        self._lines = outer
        (_, yes), (_, no) = ends
        self._lines += [f"if ({chosen}) {{", *yes, "} else {", *no, "}"]
        for name in scope.keys() & set(names):
            del scope[name]
        scope.update({name: self._got(places[name], kind) for name, kind in kinds.items()})
        return None

    def _repeat(self, names: set[str], more: Callable[[], Block], body: Callable[[Scope], None], scope: Scope) -> None:
        given = {name: scope[name] for name in sorted(names & scope.keys())}
        kinds = {name: self._join(value, value) for name, value in given.items()}
        outer = self._lines
        for last in (False, False, True):
            before: list[str] = []
            self._lines = before
            places = {name: self._variables(kind) for name, kind in kinds.items()}
            for name, kind in kinds.items():
                self._put(places[name], self._fit(given[name], kind))
            inside: list[str] = []
            self._lines = inside
            scope.update({name: self._got(places[name], kind) for name, kind in kinds.items()})
            inside.append(f"if (!{more().value[0]}) {{ break; }}")
            inner = dict(scope)
            body(inner)
            self._lines = []  # what is converted here is of no use
            joined = {name: self._join(self._fit(given[name], kind), inner[name]) for name, kind in kinds.items()}
            if joined == kinds or last:
                break
            kinds = joined
        self._lines = inside
        for name, kind in kinds.items():
            self._put(places[name], self._fit(inner[name], kind))
        self._lines = outer
        self._lines += [*before, "loop {", *inside, "}"]
        scope.update({name: self._got(places[name], kind) for name, kind in kinds.items()})

    # ---- numbers

    def constant(self, number: complex, kind: str, shape: Shape = ()) -> Block:
        plain: Any = number
        if kind == "i1":
            text = "true" if number else "false"
        elif kind[0] == "f":
            value = float(plain)
            value = value if abs(value) < _LARGEST else math.copysign(_LARGEST, value)  # also for NaN
            text = f"{struct.unpack('f', struct.pack('f', value))[0]!r}f"
        else:
            text = f"i32({int(plain)})"
        return Block((text,) * math.prod(shape), kind, shape)

    def convert(self, block: Block, kind: str) -> Block:
        if block.kind == kind:
            return block
        old, new = _TYPES[block.kind], _TYPES[kind]
        if old == new:
            return replace(block, kind=kind)
        return self._made_of(kind, block.shape, [f"{new}({x})" for x in block.value])

    def splat(self, block: Block, shape: Shape) -> Block:
        lanes = math.prod(shape)
        if block.lanes not in (1, lanes):
            raise TranslationError(f"blocks of the shapes {block.shape} and {shape} do not fit")
        return Block(block.value if block.lanes == lanes else block.value * lanes, block.kind, shape)

    def _by_lanes(self, kind: str, write: Callable[..., str], *blocks: Block) -> Block:
        return self._made_of(kind, blocks[0].shape, [write(*x) for x in zip(*(b.value for b in blocks), strict=True)])

    def unary(self, name: str, x: Value) -> Block:
        block = self.convert(self.block(x), "f32")
        return self._by_lanes("f32", lambda a: f"{_FUNCTIONS.get(name, name)}({a})", block)

    def arithmetic(self, sign: str, x: Value, y: Value) -> Value:
        if isinstance(x, Pointer) or isinstance(y, Pointer):
            return super().arithmetic(sign, x, y)
        a, b = self.matched(x, y)
        if a.kind == "i1" and sign not in "&|^":
            a, b = (self.convert(block, "i32") for block in (a, b))
        if sign == "/" and not a.floating:
            a, b = (self.convert(block, "f32") for block in (a, b))
        shown = {"//": "/", "^": "!=" if a.kind == "i1" else "^"}.get(sign, sign)
        second = "u32({})" if sign in ("<<", ">>") else "{}"
        return self._by_lanes(a.kind, lambda p, q: f"({p} {shown} {second.format(q)})", a, b)

    def rounded(self, sign: str, x: Value, y: Value) -> Block:
        found: Block = self.arithmetic(sign, x, y)
        return found

    def negative(self, x: Block) -> Block:
        return self._by_lanes(x.kind, lambda a: f"-({a})", x)

    def bits(self, x: Block, kind: str) -> Block:
        return self._by_lanes(kind, lambda a: f"bitcast<{_TYPES[kind]}>({a})", x)

    def compare(self, sign: str, x: Value, y: Value) -> Block:
        return self._by_lanes("i1", lambda p, q: f"({p} {sign} {q})", *self.matched(x, y))

    def where(self, condition: Value, x: Value, y: Value) -> Value:
        chosen = self.convert(self.block(condition), "i1")
        a, b = self.matched(x, y)
        shape = self.common_shape(chosen.shape, a.shape)
        chosen, a, b = (self.splat(block, shape) for block in (chosen, a, b))
        return self._by_lanes(a.kind, lambda c, p, q: f"select({q}, {p}, {c})", chosen, a, b)

    def extreme(self, which: str, x: Value, y: Value, nan: bool = False) -> Block:
        """What it gives for NaN is not known."""
        a, b = self.matched(x, y)
        return self._by_lanes(a.kind, lambda p, q: f"{which}({p}, {q})", a, b)

    def _function(self, name: str, x: Value) -> Block:
        return self.unary("exp", x) if name == "exp" else elementary.log(self, self.block(x))

    def arange(self, start: int, end: int) -> Block:
        return Block(tuple(f"{k}i" for k in range(start, end)), "i32", (end - start,))

    def reduce(self, which: str, x: Block, axis: int | None = None) -> Block:
        if x.kind == "i1":
            x = self.convert(x, "i32")
        shape = () if axis is None else x.shape[:axis] + x.shape[axis + 1 :]
        if x.lanes == 1 or (axis is not None and x.shape[axis] == 1):
            return replace(x, shape=shape)
        lanes = [Block((each,), x.kind) for each in x.value]
        while len(lanes) > 1:
            half = len(lanes) // 2
            lanes = [
                self.arithmetic("+", a, b) if which == "sum" else self.extreme(which, a, b)
                for a, b in zip(lanes[:half], lanes[half:], strict=True)
            ]
        return replace(lanes[0], shape=shape)

    # ---- memory

    def load(self, pointer: Pointer, mask: Value = None, other: Value = None) -> Block:
        kind = pointer.kind
        mask, shape = self._where(pointer, mask)
        offset = self.splat(pointer.offset, shape)
        if kind in ("i1", "i8"):
            first = pointer.base
            found = self._by_lanes("i8", lambda at: f"extractBits(i32(memory[u32({first} + {at}) >> 2u]), "
                                   f"(u32({first} + {at}) & 3u) * 8u, 8u)", offset)  # fmt: skip
        else:
            word, size = pointer.base // 4, {"i64": 2, "f64": 2}.get(kind, 1)
            if kind == "f64":
                raise TranslationError("numbers of double precision cannot be loaded")
            times = "" if size == 1 else " * 2"
            to = _TYPES[kind]
            found = self._by_lanes(kind, lambda at: f"bitcast<{to}>(memory[u32({word} + {at}{times})])", offset)
        if mask is not None:
            found = self.where(mask, found, self.convert(self.block(0 if other is None else other), found.kind))
        return self.convert(found, "i1") if kind == "i1" else found

    def store(self, pointer: Pointer, value: Value, mask: Value = None) -> None:
        if pointer.kind not in ("i32", "f32"):
            raise TranslationError(f"numbers of the type {pointer.kind} cannot be stored")
        block = self.convert(self.block(value), pointer.kind)
        mask, shape = self._where(pointer, mask, block)
        given = [self.splat(each, shape).value for each in (pointer.offset, block)]
        masks = ["true"] * math.prod(shape) if mask is None else self.splat(mask, shape).value
        for at, number, real in zip(*given, masks, strict=True):
            text = f"memory[u32({pointer.base // 4} + {at})] = bitcast<u32>({number});"
            self._lines.append(text if real == "true" else f"if ({real}) {{ {text} }}")

    def atomic(self, operation: str, pointer: Pointer, value: Value, mask: Value = None) -> Block:
        """Only the largest of positive numbers, which are in the order of their bits."""
        block = self.block(value)
        if operation != "max" or pointer.kind != "f32" or mask is not None or block.lanes != 1:
            raise TranslationError("shaders only find the largest number")
        if pointer.base not in self._peaks:
            self._peaks.append(pointer.base)
        at = self._peaks.index(pointer.base)
        self._lines.append(f"atomicMax(&peaks[{at}], bitcast<u32>({block.value[0]}));")
        return self.constant(0, "f32")


__all__ = ["GROUP", "shaders"]
