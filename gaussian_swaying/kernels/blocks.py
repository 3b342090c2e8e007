"""Values of a kernel while it is translated: blocks of numbers, pointers to them, and the instructions between them.

A block is a number, or a vector of one number for each lane; at most one of its axes is longer than one. Types follow
Triton's rules: a Python number takes the type of the block beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

from llvmlite import ir

Shape = tuple[int, ...]

TYPES: dict[str, ir.Type] = {
    "i1": ir.IntType(1),
    "i8": ir.IntType(8),
    "i32": ir.IntType(32),
    "i64": ir.IntType(64),
    "f32": ir.FloatType(),
    "f64": ir.DoubleType(),
}
ORDER = list(TYPES)
FAST = ("contract",)
ADDRESS = ir.PointerType()


class TranslationError(Exception):
    """A kernel uses something that the translator does not know."""


@dataclass(frozen=True)
class Block:
    """Numbers of one type, one for each lane.

    Attributes:
        value: The LLVM value: a scalar if the shape has one entry, else a vector of all entries.
        kind: Key of :data:`TYPES`.
        shape: Its shape.
        first: If the numbers of neighbouring lanes differ by a constant: the number of the first lane, a scalar.
        stride: That constant.
    """

    value: Any
    kind: str
    shape: Shape = ()
    first: Any = None
    stride: int = 0

    @property
    def lanes(self) -> int:
        return math.prod(self.shape)

    @property
    def floating(self) -> bool:
        return self.kind[0] == "f"


@dataclass(frozen=True)
class Pointer:
    """Addresses of numbers: a buffer and offsets [entries].

    Attributes:
        base: The address of the buffer.
        kind: Type of its entries; ``bool`` is stored as a byte.
        offset: Integers.
    """

    base: Any
    kind: str
    offset: Block


Value = Any
"""A ``Block``, a ``Pointer``, a tuple of values, or a constant of the translation, such as a number or an object."""


def is_number(value: Value) -> bool:
    """True if a value is a number known at translation."""
    return isinstance(value, (bool, int, float))


@lru_cache(maxsize=4096)
def _constant(number: Any, sign: float, kind: str, shape: Shape) -> Block:
    """LLVM's constant is immutable, and writes itself once."""
    lanes = math.prod(shape)
    if lanes == 1:
        return Block(ir.Constant(TYPES[kind], number), kind, shape)
    return Block(ir.Constant(ir.VectorType(TYPES[kind], lanes), [number] * lanes), kind, shape)


class Emitter:
    """Emits LLVM instructions for operations on blocks.

    Args:
        real: Type of the floating point numbers: f32 or f64.
    """

    def __init__(self, real: str) -> None:
        self.real = real
        self.builder: ir.IRBuilder = cast(Any, None)
        self.entry: ir.IRBuilder = cast(Any, None)
        """A builder at the start of the function, for its variables."""
        self.module = ir.Module()
        self._dummy: dict[str, Any] = {}

    # ---- making and converting blocks

    @staticmethod
    def type_of(kind: str, lanes: int) -> ir.Type:
        return TYPES[kind] if lanes == 1 else ir.VectorType(TYPES[kind], lanes)

    def constant(self, number: complex, kind: str, shape: Shape = ()) -> Block:
        plain: Any = float(cast(float, number)) if kind[0] == "f" else int(cast(float, number))
        return _constant(plain, math.copysign(1, plain), kind, shape)  # 0.0 and -0.0 are equal

    def block(self, value: Value, like: Block | None = None) -> Block:
        """A value as a block; a Python number takes the type of ``like``, if it can."""
        if isinstance(value, Block):
            return value
        if not is_number(value):
            raise TranslationError(f"expected a number, not {value!r}")
        if isinstance(value, bool):
            kind = "i1"
        elif isinstance(value, int):
            fits = -(2**31) <= value < 2**31
            kind = like.kind if like is not None and like.kind not in ("i1", "i8") else "i32" if fits else "i64"
            if kind == "i32" and not fits:
                kind = "i64"
        else:
            kind = like.kind if like is not None and like.floating else self.real
        return self.constant(value, kind)

    def convert(self, block: Block, kind: str) -> Block:
        old, b = block.kind, self.builder
        if old == kind:
            return block
        if isinstance(block.value, ir.Constant) and block.lanes == 1 and isinstance(block.value.constant, (int, float)):
            return self.constant(block.value.constant, kind, block.shape)
        to = self.type_of(kind, block.lanes)
        if kind == "i1":
            return self.compare("!=", block, self.constant(0, old))
        if block.floating:
            if kind[0] == "f":
                value = b.fpext(block.value, to) if kind == "f64" else b.fptrunc(block.value, to)
            else:
                value = self._float_to_int(block, to)
        elif kind[0] == "f":
            value = b.uitofp(block.value, to) if old == "i1" else b.sitofp(block.value, to)
        elif ORDER.index(kind) < ORDER.index(old):
            value = b.trunc(block.value, to)
        else:
            value = b.zext(block.value, to) if old == "i1" else b.sext(block.value, to)
        made = Block(value, kind, block.shape)
        if block.first is not None and kind[0] == "i":
            first = self.convert(Block(block.first, old), kind).value
            made = replace(made, first=first, stride=block.stride)
        return made

    def _float_to_int(self, block: Block, to: ir.Type) -> Any:
        return self.intrinsic("llvm.fptosi.sat", [block.value], to, [to, block.value.type])

    def splat(self, block: Block, shape: Shape) -> Block:
        lanes = math.prod(shape)
        if block.lanes == lanes:
            return block if block.shape == shape else replace(block, shape=shape)
        if block.lanes != 1:
            raise TranslationError(f"blocks of the shapes {block.shape} and {shape} do not fit")
        if isinstance(block.value, ir.Constant) and isinstance(block.value.constant, (int, float)):
            made = self.constant(block.value.constant, block.kind, shape)
        else:
            vector, index = ir.VectorType(TYPES[block.kind], lanes), ir.IntType(32)
            one = self.builder.insert_element(ir.Constant(vector, ir.Undefined), block.value, index(0))
            mask = self.constant(0, "i32", (lanes,)).value
            made = Block(self.builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), mask), block.kind, shape)
        return replace(made, first=block.value, stride=0) if block.kind in ("i32", "i64") else made

    @staticmethod
    @lru_cache(maxsize=4096)
    def common_shape(*shapes: Shape) -> Shape:
        """The shape to which the blocks of an operation are broadcast."""
        rank = max(map(len, shapes))
        padded = [(1,) * (rank - len(shape)) + shape for shape in shapes]
        found = tuple(max(sizes) for sizes in zip(*padded, strict=True))
        if sum(size > 1 for size in found) > 1:
            raise TranslationError(f"a block of the shape {found} has two axes; choose smaller blocks on a CPU")
        for shape in padded:
            if any(size not in (1, whole) for size, whole in zip(shape, found, strict=True)):
                raise TranslationError(f"blocks of the shapes {shapes} do not fit")
        return found

    def matched(self, *values: Value) -> list[Block]:
        blocks = [value for value in values if isinstance(value, Block)]
        best = max(blocks, key=lambda block: ORDER.index(block.kind)) if blocks else None
        made = [self.block(value, best) for value in values]
        kind = max((block.kind for block in made), key=ORDER.index)
        shape = self.common_shape(*(block.shape for block in made))
        return [self.splat(self.convert(block, kind), shape) for block in made]

    # ---- operations

    def intrinsic(self, name: str, arguments: Sequence[Any], to: ir.Type, types: Sequence[ir.Type]) -> Any:
        suffix = "".join(f".{_suffix(kind)}" for kind in types)
        function = self.module.globals.get(name + suffix)
        if function is None:
            function = ir.Function(
                self.module, ir.FunctionType(to, [argument.type for argument in arguments]), name + suffix
            )
        return self.builder.call(function, arguments)

    def unary(self, name: str, x: Value) -> Block:
        """An elementwise function of floating point numbers by the name of its LLVM intrinsic."""
        block = self.block(x)
        if not block.floating:
            block = self.convert(block, self.real)
        value = self.intrinsic(f"llvm.{name}", [block.value], block.value.type, [block.value.type])
        return Block(value, block.kind, block.shape)

    def absolute(self, x: Block) -> Block:
        if x.floating:
            return self.unary("fabs", x)
        return self.where(self.compare("<", x, 0), self.arithmetic("-", 0, x), x)

    def arithmetic(self, sign: str, x: Value, y: Value) -> Value:
        """X sign y, for one of ``+ - * / // % & | ^ << >>``."""
        if isinstance(x, Pointer) or isinstance(y, Pointer):
            pointer, other = (x, y) if isinstance(x, Pointer) else (y, x)
            if sign not in "+-":
                raise TranslationError(f"a pointer has no `{sign}`")
            return replace(pointer, offset=self.arithmetic(sign, pointer.offset, other))
        a, b = self.matched(x, y)
        if a.kind in ("i1", "i8") and sign not in "&|^":
            a, b = (self.convert(block, "i32") for block in (a, b))
        if sign == "/" and not a.floating:
            a, b = (self.convert(block, self.real) for block in (a, b))
        builder = self.builder
        if a.floating:
            signs = {"+": builder.fadd, "-": builder.fsub, "*": builder.fmul, "/": builder.fdiv}
            if sign not in signs:
                raise TranslationError(f"floating point numbers have no `{sign}`")
            return Block(signs[sign](a.value, b.value, flags=FAST), a.kind, a.shape)
        whole = {
            "+": builder.add, "-": builder.sub, "*": builder.mul, "//": builder.sdiv, "%": builder.srem,
            "&": builder.and_, "|": builder.or_, "^": builder.xor, "<<": builder.shl, ">>": builder.ashr,
        }  # fmt: skip
        made = Block(whole[sign](a.value, b.value), a.kind, a.shape)
        return self._with_stride(made, sign, a, b) if sign in "+-*" and a.lanes > 1 else made

    def rounded(self, sign: str, x: Value, y: Value) -> Block:
        """A sum, product or quotient without FMA contraction."""
        a, b = self.matched(x, y)
        made = {"+": self.builder.fadd, "*": self.builder.fmul, "/": self.builder.fdiv}[sign](a.value, b.value)
        return Block(made, a.kind, a.shape)

    def negative(self, x: Block) -> Block:
        return Block(self.builder.fneg(x.value), x.kind, x.shape)

    def bits(self, x: Block, kind: str) -> Block:
        return Block(self.builder.bitcast(x.value, self.type_of(kind, x.lanes)), kind, x.shape)

    def _with_stride(self, made: Block, sign: str, a: Block, b: Block) -> Block:
        if a.first is None or b.first is None:
            return made
        builder = self.builder
        if sign == "*":
            if a.stride and b.stride:
                return made
            steps, factor = (a, b) if a.stride else (b, a)
            if not isinstance(factor.first, ir.Constant):
                return made if steps.stride else replace(made, first=builder.mul(a.first, b.first), stride=0)
            return replace(made, first=builder.mul(a.first, b.first), stride=steps.stride * factor.first.constant)
        first = builder.add(a.first, b.first) if sign == "+" else builder.sub(a.first, b.first)
        return replace(made, first=first, stride=a.stride + (b.stride if sign == "+" else -b.stride))

    def compare(self, sign: str, x: Value, y: Value) -> Block:
        a, b = self.matched(x, y)
        if a.floating:
            make = self.builder.fcmp_unordered if sign == "!=" else self.builder.fcmp_ordered
        else:
            make = self.builder.icmp_signed
        return Block(make(sign, a.value, b.value), "i1", a.shape)

    def where(self, condition: Value, x: Value, y: Value) -> Value:
        chosen = self.convert(self.block(condition), "i1")
        a, b = self.matched(x, y)
        shape = self.common_shape(chosen.shape, a.shape)
        a, b = self.splat(a, shape), self.splat(b, shape)
        return Block(self.builder.select(self.splat(chosen, shape).value, a.value, b.value), a.kind, shape)

    def extreme(self, which: str, x: Value, y: Value, nan: bool = False) -> Block:
        """The larger (``max``) or smaller (``min``) number; if one is NaN, the other, or NaN with ``nan``."""
        a, b = self.matched(x, y)
        if a.floating:
            name = f"llvm.{which}imum" if nan else f"llvm.{which}num"
            return Block(self.intrinsic(name, [a.value, b.value], a.value.type, [a.value.type]), a.kind, a.shape)
        return self.where(self.compare(">" if which == "max" else "<", a, b), a, b)

    def arange(self, start: int, end: int) -> Block:
        shape = (end - start,)
        if shape == (1,):
            return self.constant(start, "i32", shape)
        value = ir.Constant(ir.VectorType(TYPES["i32"], end - start), list(range(start, end)))
        return Block(value, "i32", shape, ir.Constant(TYPES["i32"], start), 1)

    def reduce(self, which: str, x: Block, axis: int | None = None) -> Block:
        if x.kind == "i1":
            x = self.convert(x, "i32")
        shape = () if axis is None else x.shape[:axis] + x.shape[axis + 1 :]
        if x.lanes == 1 or (axis is not None and x.shape[axis] == 1):
            return replace(x, shape=shape, first=None)
        if x.floating:
            return Block(self._halved(which, x), x.kind, shape)
        names = {"sum": "add", "max": "smax", "min": "smin"}
        value = self.intrinsic(f"llvm.vector.reduce.{names[which]}", [x.value], TYPES[x.kind], [x.value.type])
        return Block(value, x.kind, shape)

    def _halved(self, which: str, x: Block) -> Any:
        """Sum, or largest or smallest, of the lanes in halves: lane k with lane k + n/2, and so on."""
        value, lanes, b = x.value, x.lanes, self.builder
        index = ir.IntType(32)
        while lanes > 1:
            half = lanes // 2
            undefined = ir.Constant(value.type, ir.Undefined)
            low, high = (
                b.shuffle_vector(value, undefined, ir.Constant(ir.VectorType(index, half), list(range(k, k + half))))
                for k in (0, half)
            )
            if which == "sum":
                value = b.fadd(low, high)
            else:
                value = self.extreme(which, Block(low, x.kind, (half,)), Block(high, x.kind, (half,))).value
            lanes = half
        return b.extract_element(value, index(0))

    def running_sum(self, x: Block) -> Block:
        if x.lanes == 1:
            return replace(x, first=None)
        value, index, b, lanes = x.value, ir.IntType(32), self.builder, x.lanes
        nothing, step = self.constant(0, x.kind, x.shape).value, 1
        add = b.fadd if x.floating else b.add
        while step < lanes:
            places = [lanes + k if k < step else k - step for k in range(lanes)]
            moved = b.shuffle_vector(value, nothing, ir.Constant(ir.VectorType(index, lanes), places))
            value, step = add(value, moved), 2 * step
        return Block(value, x.kind, x.shape)

    # ---- memory

    def _address(self, base: Any, kind: str, offset: Any) -> Any:
        return self.builder.gep(base, [offset], source_etype=TYPES["i8" if kind == "i1" else kind])

    def _nothing(self, kind: str) -> Any:
        if kind not in self._dummy:
            stored = TYPES["i8" if kind == "i1" else kind]
            self._dummy[kind] = self.entry.alloca(stored)
            self.entry.store(ir.Constant(stored, 0), self._dummy[kind])
        return self._dummy[kind]

    def _where(self, pointer: Pointer, mask: Value, *blocks: Block) -> tuple[Block | None, Shape]:
        mask = None if mask is None or mask is True else self.convert(self.block(mask), "i1")
        return mask, self.common_shape(*(each.shape for each in (pointer.offset, *blocks, mask) if each is not None))

    def load(self, pointer: Pointer, mask: Value = None, other: Value = None) -> Block:
        kind = pointer.kind
        stored = "i8" if kind == "i1" else kind
        offset = pointer.offset
        mask, shape = self._where(pointer, mask)
        lanes, b = math.prod(shape), self.builder
        fill = self.splat(self.convert(self.block(0 if other is None else other), stored), shape)
        if lanes == 1:
            address = self._address(pointer.base, kind, offset.value)
            if mask is None:
                value = b.load(address, typ=TYPES[stored])
            else:
                value = b.load(b.select(mask.value, address, self._nothing(kind)), typ=TYPES[stored])
                value = b.select(mask.value, value, fill.value)
            made = Block(value, stored, shape)
        elif mask is None and offset.lanes == 1:
            one = Block(b.load(self._address(pointer.base, kind, offset.value), typ=TYPES[stored]), stored)
            made = self.splat(one, shape)
        else:
            whole = self.splat(offset, shape)
            taken = self.constant(1, "i1", shape) if mask is None else self.splat(mask, shape)
            to = ir.VectorType(TYPES[stored], lanes)
            size = TYPES["i32"](_bytes(stored))
            if whole.first is not None and whole.stride == 1:
                address = self._address(pointer.base, kind, whole.first)
                if mask is None:
                    value = b.load(address, align=_bytes(stored), typ=to)
                else:
                    value = self._masked("load", [address, size, taken.value, fill.value], to, [to, ADDRESS])
            else:
                addresses = self._addresses(pointer, whole)
                value = self._masked("gather", [addresses, size, taken.value, fill.value], to, [to, addresses.type])
            made = Block(value, stored, shape)
        return self.convert(made, "i1") if kind == "i1" else made

    def store(self, pointer: Pointer, value: Value, mask: Value = None) -> None:
        kind = pointer.kind
        stored = "i8" if kind == "i1" else kind
        offset = pointer.offset
        block = self.block(value)
        if kind == "i1":
            block = self.convert(block, "i1")
        block = self.convert(block, stored)
        mask, shape = self._where(pointer, mask, block)
        lanes, b = math.prod(shape), self.builder
        if lanes == 1:
            address = self._address(pointer.base, kind, offset.value)
            if mask is not None:
                address = b.select(mask.value, address, self._nothing(kind))
            b.store(block.value, address)
            return
        whole, block = self.splat(offset, shape), self.splat(block, shape)
        taken = self.constant(1, "i1", shape) if mask is None else self.splat(mask, shape)
        size = TYPES["i32"](_bytes(stored))
        if whole.first is not None and whole.stride == 1:
            address = self._address(pointer.base, kind, whole.first)
            if mask is None:
                b.store(block.value, address, align=_bytes(stored))
            else:
                self._masked("store", [block.value, address, size, taken.value], ir.VoidType(),
                             [block.value.type, ADDRESS])  # fmt: skip
        else:
            addresses = self._addresses(pointer, whole)
            self._masked("scatter", [block.value, addresses, size, taken.value], ir.VoidType(),
                         [block.value.type, addresses.type])  # fmt: skip

    def _addresses(self, pointer: Pointer, offset: Block) -> Any:
        lanes = offset.lanes
        index = ir.IntType(32)
        undefined = ir.Constant(ir.VectorType(ADDRESS, lanes), ir.Undefined)
        one = self.builder.insert_element(undefined, pointer.base, index(0))
        bases = self.builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(index, lanes), [0] * lanes))
        instruction = self.builder.gep(
            bases, [offset.value], source_etype=TYPES["i8" if pointer.kind == "i1" else pointer.kind]
        )
        instruction.type = ir.VectorType(ADDRESS, lanes)
        return instruction

    def _masked(self, what: str, arguments: Sequence[Any], to: ir.Type, types: Sequence[ir.Type]) -> Any:
        return self.intrinsic(f"llvm.masked.{what}", arguments, to, types)

    def atomic(self, operation: str, pointer: Pointer, value: Value, mask: Value = None) -> Block:
        """Atomic ``add`` or ``max`` on memory, lane after lane; returns the old values."""
        block = self.convert(self.block(value), pointer.kind)
        mask, shape = self._where(pointer, mask, block)
        b, index = self.builder, ir.IntType(32)
        names = {("add", True): "fadd", ("add", False): "add", ("max", True): "fmax", ("max", False): "max"}
        name = names[operation, block.floating]
        offset, block = self.splat(pointer.offset, shape), self.splat(block, shape)
        taken = None if mask is None else self.splat(mask, shape)
        lanes = math.prod(shape)
        before = ir.Constant(self.type_of(block.kind, lanes), None if lanes > 1 else 0)
        for lane in range(lanes):
            one = (lambda x, k=lane: x) if lanes == 1 else (lambda x, k=lane: b.extract_element(x, index(k)))
            address = self._address(pointer.base, pointer.kind, one(offset.value))
            if taken is not None:
                address = b.select(one(taken.value), address, self._nothing(pointer.kind))
            old = b.atomic_rmw(name, address, one(block.value), "acq_rel")
            before = old if lanes == 1 else b.insert_element(before, old, index(lane))
        return Block(before, block.kind, shape)


def _bytes(kind: str) -> int:
    return {"i8": 1, "i32": 4, "i64": 8, "f32": 4, "f64": 8}[kind]


def _suffix(kind: ir.Type) -> str:
    if isinstance(kind, ir.VectorType):
        return f"v{kind.count}{_suffix(kind.element)}"
    if isinstance(kind, ir.PointerType):
        return "p0"
    return {"float": "f32", "double": "f64"}.get(str(kind), str(kind))
