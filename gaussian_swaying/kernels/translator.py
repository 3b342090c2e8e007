"""Translates kernels in Triton's language to LLVM, for a CPU.

A kernel is read as Python source and carried out once, with blocks of numbers whose values are not known
(:mod:`~gaussian_swaying.kernels.blocks`) and constants that are: constant conditions are decided, functions are
expanded where they are called, short loops are unrolled. What is left are LLVM instructions. The language is the part
of Triton that the kernels of this package use, with one addition: no block may have two axes that are longer than one.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

from llvmlite import ir

from gaussian_swaying.kernels import elementary
from gaussian_swaying.kernels.blocks import ADDRESS, TYPES, Block, Emitter, Pointer, TranslationError, Value, is_number
from gaussian_swaying.kernels.language import Language, Name

_OPERATIONS: dict[type, tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("+", operator.add), ast.Sub: ("-", operator.sub), ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv), ast.FloorDiv: ("//", operator.floordiv), ast.Mod: ("%", operator.mod),
    ast.BitAnd: ("&", operator.and_), ast.BitOr: ("|", operator.or_), ast.BitXor: ("^", operator.xor),
    ast.LShift: ("<<", operator.lshift), ast.RShift: (">>", operator.rshift), ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le), ast.Gt: (">", operator.gt), ast.GtE: (">=", operator.ge), ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}  # fmt: skip
_PYTHON = {"len": len, "float": float, "int": int, "min": min, "max": max, "bool": bool, "abs": abs}


@dataclass
class _Returned:
    value: Value


class _Loop:
    def __init__(self, start: Value, end: Value, step: Value) -> None:
        self.start, self.end, self.step = start, end, step


Scope = dict[str, Value]


def translate(kernel: Any, constants: dict[str, Any], arguments: dict[str, str], real: str) -> ir.Module:
    """Return an LLVM module with a function ``kernel(arguments, first program, last program + 1)``.

    ``arguments`` points to rows of eight bytes: the grid of programs (three integers), and the arguments: addresses,
    integers and doubles.

    Args:
        arguments: The kinds of the others, in order: ``i`` and ``f`` for a number, ``*`` and a type for a pointer.
        real: Type of floating point numbers: f32 or f64.
    """
    return Translator(real).kernel(kernel, constants, arguments)


class Translator(Emitter):
    """Carries kernels out; see :func:`translate`."""

    unrolled = 4
    """Longest loop of a constant length that is unrolled; the language's ``static_range`` always is."""
    _globals: dict[str, Any] | None = None
    """Names of the module of the function that is carried out."""
    _line = 1
    """Line of its statement."""
    _leave: Any = None
    """The block behind the kernel, where it may end now: outside of its loops and of the functions that it calls."""

    def kernel(
        self, kernel: Any, constants: dict[str, Any], arguments: dict[str, str], name: str = "kernel"
    ) -> ir.Module:
        number = TYPES["i64"]
        kind = ir.FunctionType(ir.VoidType(), [ADDRESS, number, number])
        function = ir.Function(self.module, kind, name)
        entry = function.append_basic_block("entry")
        self.entry = ir.IRBuilder(entry)
        start = function.append_basic_block("start")
        self.builder = ir.IRBuilder(start)
        rows, first, last = function.args
        self._grid = [Block(self._slot(rows, k, number), "i64") for k in range(3)]
        scope: Scope = {name: _plain(value) for name, value in constants.items()}
        for k, (name, what) in enumerate(arguments.items()):
            scope[name] = self._argument(rows, 3 + k, what)
        begin = self._place(first)
        before = self.builder.block
        head = function.append_basic_block("program")
        body = function.append_basic_block("body")
        end = function.append_basic_block("end")
        self.builder.branch(head)
        self.builder.position_at_end(head)
        program, *place = (self.builder.phi(number) for _ in range(4))
        for phi, value in zip((program, *place), (first, *begin), strict=True):
            phi.add_incoming(value, before)
        self.builder.cbranch(self.builder.icmp_signed("<", program, last), body, end)
        self.builder.position_at_end(body)
        self._program = [self.convert(Block(each, "i64"), "i32") for each in place]
        leave = function.append_basic_block("leave")
        self._call(kernel, (), scope, leave)
        self.builder.branch(leave)
        self.builder.position_at_end(leave)
        following = [self.builder.add(program, number(1)), *self._next(place)]
        for phi, value in zip((program, *place), following, strict=True):
            phi.add_incoming(value, self.builder.block)
        self.builder.branch(head)
        self.builder.position_at_end(end)
        self.builder.ret_void()
        self.entry.branch(start)
        return self.module

    def _slot(self, rows: Any, k: int, kind: ir.Type) -> Any:
        place = self.builder.gep(rows, [TYPES["i64"](k)], source_etype=TYPES["i64"])
        return self.builder.load(place, typ=kind)

    def _argument(self, rows: Any, k: int, what: str) -> Value:
        if what[0] == "*":
            return Pointer(self._slot(rows, k, ADDRESS), what[1:], self.constant(0, "i32"))
        if what == "f":
            return self.convert(Block(self._slot(rows, k, TYPES["f64"]), "f64"), self.real)
        return self.convert(Block(self._slot(rows, k, TYPES["i64"]), "i64"), "i32" if what == "i" else "i64")

    def _place(self, program: Any) -> list[Any]:
        b, (x, y, _) = self.builder, self._grid
        rest = b.sdiv(program, x.value)
        return [b.srem(program, x.value), b.srem(rest, y.value), b.sdiv(rest, y.value)]

    def _next(self, place: list[Any]) -> list[Any]:
        b, one, zero = self.builder, TYPES["i64"](1), TYPES["i64"](0)
        full, following = None, []
        for number, count in zip(place, self._grid, strict=True):
            moved = b.add(number, one) if full is None else b.add(number, b.zext(full, TYPES["i64"]))
            full = b.icmp_signed("==", moved, count.value)
            following.append(b.select(full, zero, moved))
        return following

    # ---- functions

    def _call(self, function: Any, arguments: tuple[Value, ...], named: Scope, leave: Any = None) -> Value:
        """Carry out a function of the language, which may branch to the block ``leave``."""
        tree, names, defaults, constant = _source(function)
        scope: Scope = dict(zip(names, arguments, strict=False))
        for name, value in named.items():
            if name not in names or name in scope:
                raise TranslationError(f"{function.fn.__name__} has no argument {name}, or it is given twice")
            scope[name] = value
        for name in names:
            if name not in scope:
                if name not in defaults:
                    raise TranslationError(f"{function.fn.__name__} needs the argument {name}")
                scope[name] = defaults[name]
            if name in constant and isinstance(scope[name], Block):
                raise TranslationError(f"{name} of {function.fn.__name__} is no constant")
        outer = self._globals, self._line, self._leave
        self._globals, self._leave = function.fn.__globals__, leave
        try:
            found = self._run(tree.body, scope)
        except TranslationError as error:
            if not getattr(error, "placed", False):
                error.placed = True  # type: ignore[attr-defined]
                error.args = (f"{function.fn.__module__}.{function.fn.__name__}, near line {self._line}: {error}",)
            raise
        finally:
            self._globals, self._line, self._leave = outer
        return None if found is None else found.value

    # ---- statements

    def _run(self, body: list[ast.stmt], scope: Scope) -> _Returned | None:
        for statement in body:
            self._line = statement.lineno
            found = self._statement(statement, scope)
            if found is not None:
                return found
        return None

    def _statement(self, node: ast.stmt, scope: Scope) -> _Returned | None:
        match node:
            case ast.Assign(targets=[target], value=value):
                self._assign(target, self._eval(value, scope), scope)
            case ast.AnnAssign(target=target, value=value) if value is not None:
                self._assign(target, self._eval(value, scope), scope)
            case ast.AugAssign(target=ast.Name(id=name), op=op, value=value):
                scope[name] = self._binary(op, self._lookup(name, scope), self._eval(value, scope))
            case ast.Expr(value=ast.Constant()) | ast.Pass():
                pass
            case ast.Expr(value=value):
                self._eval(value, scope)
            case ast.Return(value=value):
                return _Returned(None if value is None else self._eval(value, scope))
            case ast.If():
                return self._if(node, scope)
            case ast.For():
                return self._for(node, scope)
            case ast.While():
                self._while(node, scope)
            case _:
                raise TranslationError(f"cannot translate `{ast.unparse(node)}`")
        return None

    def _assign(self, target: ast.expr, value: Value, scope: Scope) -> None:
        match target:
            case ast.Name(id=name):
                scope[name] = value
            case ast.Tuple(elts=parts):
                if not isinstance(value, tuple) or len(value) != len(parts):
                    raise TranslationError(f"cannot unpack {value!r} into {len(parts)} names")
                for part, one in zip(parts, value, strict=True):
                    self._assign(part, one, scope)
            case _:
                raise TranslationError(f"cannot assign to `{ast.unparse(target)}`")

    def _if(self, node: ast.If, scope: Scope) -> _Returned | None:
        condition = self._eval(node.test, scope)
        if not isinstance(condition, Block):
            return self._run(node.body if condition else node.orelse, scope)
        b, function = self.builder, self.builder.function
        if condition.lanes != 1:
            raise TranslationError("a condition must be one number")
        names = _assigned(node.body) | _assigned(node.orelse)
        yes, no, after = (function.append_basic_block() for _ in range(3))
        b.cbranch(self.convert(condition, "i1").value, yes, no)
        ends: list[tuple[Scope, Any]] = []
        for block, body in ((yes, node.body), (no, node.orelse)):
            b.position_at_end(block)
            inner = dict(scope)
            found = self._run(body, inner)
            if found is None:
                ends.append((inner, b.block))
            elif found.value is None and self._leave is not None:
                b.branch(self._leave)
            else:
                raise TranslationError("cannot return under a condition that is not constant")
        if not ends:
            b.position_at_end(after)
            return _Returned(None)
        if len(ends) == 1:
            b.position_at_end(ends[0][1])
            b.branch(after)
            b.position_at_end(after)
            scope |= ends[0][0]
            return None
        (first, here), (second, there) = ends
        pairs = {name: (first[name], second[name]) for name in sorted(names) if name in first and name in second}
        kinds = {name: self._join(*pair) for name, pair in pairs.items()}
        values = []
        for side, block in enumerate((here, there)):
            b.position_at_end(block)
            values.append({name: self._fit(pair[side], kinds[name]) for name, pair in pairs.items()})
            b.branch(after)
        b.position_at_end(after)
        for name in scope.keys() & names:
            if name not in pairs:
                del scope[name]
        for name in pairs:
            scope[name] = self._phi(kinds[name], (values[0][name], here), (values[1][name], there))
        return None

    def _for(self, node: ast.For, scope: Scope) -> _Returned | None:
        if not isinstance(node.target, ast.Name):
            raise TranslationError("a loop has one variable")
        values = self._eval(node.iter, scope)
        if not isinstance(values, _Loop):
            for value in values:
                scope[node.target.id] = value
                found = self._run(node.body, scope)
                if found is not None:
                    return found
            return None
        name, counter = node.target.id, f"counter {node.target.id}"
        start, end, step = self.matched(values.start, values.end, values.step)
        scope[counter] = start

        def more() -> Block:
            return self.compare("<", scope[counter], end)

        def body(inner: Scope) -> None:
            inner[name] = inner[counter]
            if self._run(node.body, inner) is not None:
                raise TranslationError("cannot return from a loop")
            inner[counter] = self.arithmetic("+", inner[counter], step)

        self._repeat(_assigned(node.body) | {counter}, more, body, scope)
        return None

    def _while(self, node: ast.While, scope: Scope) -> None:
        inner_scope = scope

        def body(inner: Scope) -> None:
            if self._run(node.body, inner) is not None:
                raise TranslationError("cannot return from a loop")

        self._repeat(_assigned(node.body), lambda: self._truth(node.test, inner_scope), body, scope)

    def _truth(self, test: ast.expr, scope: Scope) -> Block:
        return self.convert(self.block(self._eval(test, scope)), "i1")

    def _repeat(self, names: set[str], more: Callable[[], Block], body: Callable[[Scope], None], scope: Scope) -> None:
        """A loop; what it changes is kept in memory, which LLVM turns into registers.

        The body is carried out with the types from before the loop. If it changes them, it is taken back, and carried
        out again with the types of both.
        """
        leave, self._leave = self._leave, None
        given = {name: scope[name] for name in sorted(names & scope.keys())}
        kinds = {name: self._join(value, value) for name, value in given.items()}
        b, function = self.builder, self.builder.function
        here, done, before = b.block, len(b.block.instructions), len(function.blocks)
        for last in (False, False, True):
            places = {name: self._places(kind) for name, kind in kinds.items() if not isinstance(kind, _Same)}
            for name in places:
                self._keep(places[name], self._fit(given[name], kinds[name]))
            head, inside, after = (function.append_basic_block() for _ in range(3))
            b.branch(head)
            b.position_at_end(head)
            scope.update({name: self._kept(places[name], kinds[name]) for name in places})
            b.cbranch(more().value, inside, after)
            b.position_at_end(inside)
            inner = dict(scope)
            body(inner)
            joined = kinds if last else self._joined(kinds, given, inner)
            if joined == kinds:
                break
            kinds, here.terminator = joined, None
            del here.instructions[done:], function.blocks[before:]
            b.position_at_end(here)
        for name in places:
            self._keep(places[name], self._fit(inner[name], kinds[name]))
        b.branch(head)
        b.position_at_end(after)
        self._leave = leave
        scope.update({name: self._kept(places[name], kinds[name]) for name in places})

    def _joined(self, kinds: dict[str, Any], before: Scope, after: Scope) -> dict[str, Any]:
        here, scratch = self.builder.block, ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), []), "scratch")
        self.builder.position_at_end(scratch.append_basic_block())  # what is converted here is of no use
        joined = {name: self._join(self._fit(before[name], kind), after[name]) for name, kind in kinds.items()}
        self.builder.position_at_end(here)
        return joined

    # ---- values that depend on the way

    def _join(self, x: Value, y: Value) -> Any:
        if isinstance(x, tuple) and isinstance(y, tuple) and len(x) == len(y):
            return tuple(self._join(a, b) for a, b in zip(x, y, strict=True))
        if isinstance(x, Pointer) and isinstance(y, Pointer) and x.base is y.base:
            return _Address(x.base, x.kind, self._join(x.offset, y.offset))
        if isinstance(x, (Block, bool, int, float)) and isinstance(y, (Block, bool, int, float)):
            a, _ = self.matched(x, y)
            return _Kind(a.kind, a.shape)
        if x is y or (type(x) is type(y) and x == y):
            return _Same(x)
        raise TranslationError(f"a variable is {x!r} on one way and {y!r} on another")

    def _fit(self, value: Value, kind: Any) -> Value:
        if isinstance(kind, tuple):
            return tuple(self._fit(part, own) for part, own in zip(value, kind, strict=True))
        if isinstance(kind, _Address):
            return Pointer(kind.base, kind.kind, self._fit(value.offset, kind.offset))
        if isinstance(kind, _Same):
            return kind.value
        block = self.splat(self.convert(self.block(value), kind.kind), kind.shape)
        return Block(block.value, block.kind, block.shape)

    def _leaves(self, value: Value) -> Iterator[Block]:
        if isinstance(value, tuple):
            for part in value:
                yield from self._leaves(part)
        elif isinstance(value, Pointer):
            yield value.offset
        elif isinstance(value, Block):
            yield value

    def _made(self, kind: Any, values: Iterator[Any]) -> Value:
        if isinstance(kind, tuple):
            return tuple(self._made(part, values) for part in kind)
        if isinstance(kind, _Address):
            return Pointer(kind.base, kind.kind, self._made(kind.offset, values))
        if isinstance(kind, _Same):
            return kind.value
        return Block(next(values), kind.kind, kind.shape)

    def _phi(self, kind: Any, *ways: tuple[Value, Any]) -> Value:
        columns = zip(*([leaf.value for leaf in self._leaves(value)] for value, _ in ways), strict=True)
        made = []
        for column in columns:
            phi = self.builder.phi(column[0].type)
            for value, (_, block) in zip(column, ways, strict=True):
                phi.add_incoming(value, block)
            made.append(phi)
        return self._made(kind, iter(made))

    def _places(self, kind: Any) -> list[Any]:
        if isinstance(kind, tuple):
            return [place for part in kind for place in self._places(part)]
        if isinstance(kind, _Address):
            return self._places(kind.offset)
        if isinstance(kind, _Same):
            return []
        to = self.type_of(kind.kind, math.prod(kind.shape))
        return [(self.entry.alloca(to), to)]

    def _keep(self, places: list[Any], value: Value) -> None:
        for (place, _), leaf in zip(places, self._leaves(value), strict=True):
            self.builder.store(leaf.value, place)

    def _kept(self, places: list[Any], kind: Any) -> Value:
        return self._made(kind, iter([self.builder.load(place, typ=to) for place, to in places]))

    # ---- expressions

    def _lookup(self, name: str, scope: Scope) -> Value:
        if name in scope:
            return scope[name]
        if self._globals is not None and name in self._globals:
            return _plain(self._globals[name])
        if name in _PYTHON or name in ("range", "tuple"):
            return getattr(builtins, name)
        raise TranslationError(f"`{name}` is not known here")

    def _eval(self, node: ast.expr, scope: Scope) -> Value:
        match node:  # the frequent ones first
            case ast.Name(id=name):
                return self._lookup(name, scope)
            case ast.Call(func=func, args=args, keywords=keywords):
                named = {word.arg: self._eval(word.value, scope) for word in keywords if word.arg is not None}
                return self._invoke(self._eval(func, scope), tuple(self._eval(arg, scope) for arg in args), named)
            case ast.BinOp(left=left, op=op, right=right):
                return self._binary(op, self._eval(left, scope), self._eval(right, scope))
            case ast.Attribute(value=owner, attr=attr):
                return self._attribute(self._eval(owner, scope), attr)
            case ast.Constant(value=value):
                return value
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return self._compare(op, self._eval(left, scope), self._eval(right, scope))
            case ast.Tuple(elts=parts):
                return tuple(self._eval(part, scope) for part in parts)
            case ast.List(elts=parts):
                return tuple(self._eval(part, scope) for part in parts)
            case ast.UnaryOp(op=op, operand=operand):
                return self._one(op, self._eval(operand, scope))
            case ast.BoolOp(op=op, values=values):
                return self._logic(op, values, scope)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                condition = self._eval(test, scope)
                if isinstance(condition, Block):
                    return self.where(condition, self._eval(body, scope), self._eval(orelse, scope))
                return self._eval(body if condition else orelse, scope)
            case ast.Subscript(value=owner, slice=index):
                return self._item(self._eval(owner, scope), index, scope)
        raise TranslationError(f"cannot translate `{ast.unparse(node)}`")

    def _binary(self, op: ast.operator, x: Value, y: Value) -> Value:
        if isinstance(x, tuple) and isinstance(y, tuple) and isinstance(op, ast.Add):
            return x + y
        if type(op) not in _OPERATIONS:
            if isinstance(op, ast.Pow) and is_number(x) and is_number(y):
                return x**y
            raise TranslationError(f"no operation {type(op).__name__}")
        sign, plain = _OPERATIONS[type(op)]
        return plain(x, y) if is_number(x) and is_number(y) else self.arithmetic(sign, x, y)

    def _one(self, op: ast.unaryop, x: Value) -> Value:
        if isinstance(op, ast.Not):
            return self.compare("==", self.convert(x, "i1"), self.constant(0, "i1")) if isinstance(x, Block) else not x
        if is_number(x):
            return -x if isinstance(op, ast.USub) else ~x if isinstance(op, ast.Invert) else +x
        if isinstance(op, ast.USub):
            return self.negative(x) if x.floating else self.arithmetic("-", 0, x)
        if isinstance(op, ast.Invert):
            return self.arithmetic("^", x, True if x.kind == "i1" else -1)
        return x

    def _compare(self, op: ast.cmpop, x: Value, y: Value) -> Value:
        if isinstance(op, (ast.Is, ast.IsNot)):
            return (x is y) == isinstance(op, ast.Is)
        sign, plain = _OPERATIONS[type(op)]
        return self.compare(sign, x, y) if isinstance(x, Block) or isinstance(y, Block) else plain(x, y)

    def _logic(self, op: ast.boolop, values: list[ast.expr], scope: Scope) -> Value:
        stops = isinstance(op, ast.Or)
        made: Value = not stops
        for value in values:
            one = self._eval(value, scope)
            if isinstance(one, Block):
                one = self.convert(one, "i1")
                made = self.arithmetic("|" if stops else "&", made, one)
            elif bool(one) == stops:
                return one
        return made

    def _attribute(self, owner: Value, attr: str) -> Value:
        if isinstance(owner, Language) or getattr(owner, "__name__", "") == "triton.language":
            return Name(attr)
        if isinstance(owner, Name):
            return Name(f"{owner.name}.{attr}")
        if isinstance(owner, Block):
            if attr == "to":
                return lambda kind: self._to(owner, kind)
            if attr == "dtype":
                return Name({"f32": "float32", "f64": "float64", "i32": "int32", "i64": "int64"}[owner.kind])
            if attr == "shape":
                return owner.shape
            raise TranslationError(f"a block has no `{attr}`")
        return _plain(getattr(owner, attr))

    def _item(self, owner: Value, index: ast.expr, scope: Scope) -> Value:
        if isinstance(owner, Pointer):
            return Pointer(owner.base, owner.kind, self._item(owner.offset, index, scope))
        if isinstance(owner, Block):
            parts = index.elts if isinstance(index, ast.Tuple) else [index]
            shape, sizes = [], iter(owner.shape)
            for part in parts:
                new = isinstance(part, ast.Constant) and part.value is None
                shape.append(1 if new else next(sizes))
            made = Block(owner.value, owner.kind, (*shape, *sizes), owner.first, owner.stride)
            self.common_shape(made.shape)
            return made
        key = self._eval(index, scope)
        if isinstance(key, Block):
            raise TranslationError("the place in a tuple must be constant")
        return _plain(owner[key])

    def _to(self, block: Block, kind: Value) -> Block:
        return self.convert(block, self._kind(kind))

    def _kind(self, kind: Value) -> str:
        name = kind.name if isinstance(kind, Name) else str(kind)
        kinds = {"float32": self.real, "float64": "f64", "int32": "i32", "int64": "i64", "int1": "i1", "int8": "i8",
                 "uint8": "i8"}  # fmt: skip
        if name not in kinds:
            raise TranslationError(f"no type {name}")
        return kinds[name]

    def _invoke(self, function: Any, arguments: tuple[Value, ...], named: Scope) -> Value:
        if isinstance(function, Name):
            return self._named(function.name)(*arguments, **named)
        if hasattr(function, "fn"):
            return self._call(function, arguments, named)
        if function is range:
            return self._range(*arguments)
        if getattr(function, "__name__", "") == "<lambda>" or function in _PYTHON.values():
            return function(*arguments)
        raise TranslationError(f"cannot call {function!r}")

    def _range(self, *limits: Value) -> Value:
        start, end, step = (0, *limits, 1) if len(limits) == 1 else (*limits, 1)[:3]
        if all(is_number(limit) for limit in (start, end, step)) and len(range(start, end, step)) <= self.unrolled:
            return range(start, end, step)
        return _Loop(start, end, step)

    # ---- the language

    def _named(self, name: str) -> Callable[..., Value]:
        match name:
            case "load" | "store" | "where" | "arange":
                return getattr(self, name)
            case "sqrt" | "sin" | "cos" | "floor":
                return partial(self.unary, name)
            case "sum" | "max" | "min":
                return partial(self.reduce, name)
            case "maximum" | "minimum":
                return partial(self._extreme, name[:3])
            case "atomic_add" | "atomic_max":
                return lambda pointer, x, mask=None, **_: self.atomic(name[7:], pointer, x, mask)
            case "exp" | "log":
                return partial(self._function, name)
            case "static_range":
                return range
            case "program_id":
                return self._program.__getitem__
            case "num_programs":
                return lambda axis: self.convert(self._grid[axis], "i32")
            case "zeros":
                return lambda shape, dtype: self.constant(0, self._kind(dtype), tuple(shape))
            case "full":
                return lambda shape, x, dtype: self.splat(self.convert(self.block(x), self._kind(dtype)), tuple(shape))
            case "zeros_like":
                return lambda x: self.constant(0, x.kind, x.shape)
            case "abs":
                return lambda x: abs(x) if is_number(x) else self.absolute(x)
            case "cumsum":
                return lambda x, axis=0: self.running_sum(x) if x.shape[axis] == x.lanes else x
            case "div_rn":
                return partial(self.rounded, "/")
            case "debug_barrier":  # the lanes of a program need not wait for each other here
                return lambda: None
        raise TranslationError(f"`tl.{name}` is not translated")

    def _extreme(self, which: str, x: Value, y: Value, propagate_nan: Value = None) -> Value:
        if is_number(x) and is_number(y):
            return max(x, y) if which == "max" else min(x, y)
        name = propagate_nan.name if isinstance(propagate_nan, Name) else str(propagate_nan)
        return self.extreme(which, x, y, name.endswith("ALL"))

    def _function(self, name: str, x: Value) -> Block:
        block = self.block(x)
        if block.kind != "f32":
            return self.unary(name, block)
        return (elementary.exp if name == "exp" else elementary.log)(self, block)


@dataclass(frozen=True)
class _Kind:
    kind: str
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Address:
    base: Any
    kind: str
    offset: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Address) and self.base is other.base and self.offset == other.offset


@dataclass(frozen=True)
class _Same:
    value: Any


def _plain(value: Any) -> Any:
    while type(value).__name__ in ("Constant", "constexpr") and hasattr(value, "value"):
        value = value.value
    return value


def _assigned(body: list[ast.stmt]) -> set[str]:
    found = set()
    for statement in body:
        for node in ast.walk(statement):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.id)
    return found


@lru_cache(maxsize=1024)
def _source(function: Any) -> tuple[ast.FunctionDef, list[str], dict[str, Any], set[str]]:
    lines, first = inspect.getsourcelines(function.fn)
    source = ast.parse(textwrap.dedent("".join(lines)))
    tree = next(node for node in ast.increment_lineno(source, first - 1).body if isinstance(node, ast.FunctionDef))
    names = [argument.arg for argument in tree.args.args]
    marked = {a.arg for a in tree.args.args if a.annotation is not None and "constexpr" in ast.unparse(a.annotation)}
    given = inspect.signature(function.fn).parameters
    defaults = {name: _plain(p.default) for name, p in given.items() if p.default is not inspect.Parameter.empty}
    return tree, names, defaults, marked


__all__ = ["TranslationError", "Translator", "translate"]
