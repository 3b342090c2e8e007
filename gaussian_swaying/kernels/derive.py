"""Runs device functions on torch tensors and on symbols, and derives new device functions from them.

A device function is the one text of a formula. :func:`on_tensors` runs it on tensors of any type and device, which is
its definition in torch, with autograd. :func:`device_function` writes a new one from a formula of symbols, in which
:func:`gradient` is reverse mode (Griewank & Walther 2008, "Evaluating derivatives", section 3.2), :func:`tangent` its
transpose and :func:`difference` a divided difference without cancellation; :func:`vjp` is the adjoint of a whole
function. A :class:`Primitive` is not looked into: its derivatives are given.

Tuples of numbers may be nested. Conditions of ``if`` and lengths of loops must be constants. On tensors a pointer is a
:class:`Memory`; loads cannot be traced on symbols. What cannot is refused with its line.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
import inspect
import linecache
import math
import operator
import textwrap
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels.language import Constant, Language, tl, triton

Shape = int
"""Of an argument: 0 for a number, n for a tuple of n numbers."""


class TraceError(ValueError):
    """A device function does what cannot be traced."""


@dataclass(frozen=True)
class Primitive:
    """Known facts about a device function that is called as a whole.

    Attributes:
        outputs: Shape of its result: 0 for a number, n for a tuple of n, a tuple of shapes for several.
        on_tensors: The function of tensors, as tuples too; None to run its text.
        vjp: ``(arguments, result, bars)``: the gradients by the arguments from those by the result; None for a
            function without derivatives.
        difference: ``(x, y)``: the divided difference between two numbers, of a function of one.
    """

    outputs: Any = 0
    on_tensors: Callable[..., Any] | None = None
    vjp: Callable[..., Any] | None = None
    difference: Callable[..., Any] | None = None


class Memory:
    """A pointer to the numbers of a tensor, of which functions on tensors load some."""

    def __init__(self, tensor: Tensor, place: Any = 0) -> None:
        self.tensor, self.place = tensor.reshape(-1), place

    def __add__(self, step: Any) -> Memory:
        return Memory(self.tensor, self.place + step)

    def load(self, mask: Any, other: Any) -> Tensor:
        """The numbers at its places, in the type of the others; without making the host wait."""
        place = torch.as_tensor(self.place, device=self.tensor.device)
        place = place if mask is None else torch.where(mask, place, 0)
        found = self.tensor.index_select(0, place.reshape(-1).long()).reshape(place.shape).to(_REAL.get())
        return found if mask is None else torch.where(mask, found, other)


_PRIMITIVES: dict[Any, Primitive] = {}
_REAL: ContextVar[torch.dtype] = ContextVar("real", default=torch.float32)


def primitive(function: Any, outputs: Any = 0, **known: Any) -> None:
    """Register known facts about a device function, see :class:`Primitive`."""
    _PRIMITIVES[function] = Primitive(outputs, **known)


# ---- running a device function


def on_tensors(function: Any, look_in: bool = False) -> Callable[..., Any]:
    """Run a device function in Python, on tensors, numbers or symbols, and tuples of them.

    Constants are plain numbers and tuples. Tensors must broadcast; results have their type, device and gradient.

    Raises:
        TraceError: When it is called, if the function loads from memory or branches on a value.
    """

    def run(*given: Any, **named: Any) -> Any:
        found = [value.dtype for value in _leaves((given, tuple(named.values()))) if isinstance(value, Tensor)]
        real = next((kind for kind in found if kind.is_floating_point), None)
        before = None if real is None else _REAL.set(real)
        try:
            return (_python if look_in else partial(partial, _call))(function)(*given, **named)
        finally:
            if before is not None:
                _REAL.reset(before)

    return run


def _call(function: Any, *given: Any, **named: Any) -> Any:
    if not hasattr(function, "fn"):
        return function(*given, **named)
    known = _PRIMITIVES.get(function)
    if known is not None:
        leaves = list(_leaves((given, tuple(named.values()))))
        graph = next((leaf.graph for leaf in leaves if isinstance(leaf, Symbol)), None)
        if graph is not None:
            return graph.call(function, known, given)
        if known.on_tensors is not None and any(isinstance(leaf, Tensor) for leaf in leaves):
            return known.on_tensors(*given, **named)
    try:
        return _python(function)(*given, **named)
    except TraceError as error:
        if not getattr(error, "placed", False):
            error.placed = True  # type: ignore[attr-defined]
            trace, line = error.__traceback__, 0
            while trace is not None:
                line = trace.tb_lineno if trace.tb_frame.f_code.co_name == function.fn.__name__ else line
                trace = trace.tb_next
            error.args = (f"{function.fn.__module__}.{function.fn.__name__}, line {line}: {error}",)
        raise


@cache
def _python(function: Any) -> Callable[..., Any]:
    lines, first = inspect.getsourcelines(function.fn)
    tree = ast.parse(textwrap.dedent("".join(lines)))
    made = next(node for node in tree.body if isinstance(node, ast.FunctionDef))
    made.decorator_list, made.returns = [], None
    for argument in made.args.args:
        argument.annotation = None
    tree = ast.increment_lineno(ast.fix_missing_locations(_Calls().visit(tree)), first - 1)
    known = {name: _plain(value) for name, value in function.fn.__globals__.items()}
    scope = {**known, "_call": _call, "_to": _to, "_constant": _constant}
    exec(compile(tree, function.fn.__code__.co_filename, "exec"), scope)
    return scope[function.fn.__name__]


def _plain(value: Any) -> Any:
    if value is tl or isinstance(value, Language) or getattr(value, "__name__", "") == "triton.language":
        return _LANGUAGE
    constant = isinstance(value, Constant) or type(value).__name__ == "constexpr"
    return value.value if constant else value


class _Calls(ast.NodeTransformer):
    """Calls and conditions go through functions of this file."""

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "to":
            return ast.Call(ast.Name("_to", ast.Load()), [node.func.value, *node.args], [])
        return ast.Call(ast.Name("_call", ast.Load()), [node.func, *node.args], node.keywords)

    def _decided(self, node: Any) -> Any:
        self.generic_visit(node)
        node.test = ast.Call(ast.Name("_constant", ast.Load()), [node.test], [])
        return node

    visit_If = visit_While = visit_IfExp = _decided  # noqa: N815

    def visit_AugAssign(self, node: ast.AugAssign) -> Any:  # not in place, as another name may be the same tensor
        self.generic_visit(node)
        assert isinstance(node.target, ast.Name)
        return ast.Assign([node.target], ast.BinOp(ast.Name(node.target.id, ast.Load()), node.op, node.value))

    def visit_AnnAssign(self, node: ast.AnnAssign) -> Any:
        self.generic_visit(node)
        return node if node.value is None else ast.Assign([node.target], node.value)


def _constant(test: Any) -> Any:
    if isinstance(test, (Symbol, Tensor)):
        raise TraceError("a condition must be constant: use `tl.where`")
    return test


def _to(value: Any, kind: Any) -> Any:
    if isinstance(value, Tensor):
        return value.to(_REAL.get() if kind is torch.float32 else kind)
    if isinstance(value, Symbol):
        raise TraceError("a change of type cannot be traced")
    return int(value) if kind in (torch.int32, torch.int64) else value


class _TorchLanguage:
    """The functions of ``triton.language`` that formulas use, for tensors, symbols and numbers."""

    constexpr, static_range = staticmethod(lambda value: value), range
    float32, float64, int32, int64 = torch.float32, torch.float64, torch.int32, torch.int64

    class PropagateNan:
        ALL, NONE = "ALL", "NONE"

    @staticmethod
    def where(condition: Any, yes: Any, no: Any) -> Any:
        graph = _graph_of(condition, yes, no)
        if graph is not None:
            return graph.make("where", condition, yes, no)
        if not isinstance(condition, Tensor):
            return yes if condition else no
        if not isinstance(yes, Tensor) and not isinstance(no, Tensor):
            yes = torch.full((), float(yes), dtype=_REAL.get(), device=condition.device)
        return torch.where(condition, yes, no)

    @staticmethod
    def load(pointer: Any, mask: Any = None, other: Any = 0.0) -> Any:
        if not isinstance(pointer, Memory):
            raise TraceError("`tl.load` cannot be traced")
        return pointer.load(mask, other)

    @staticmethod
    def maximum(x: Any, y: Any, propagate_nan: Any = None) -> Any:
        return _extreme("maximum", x, y, propagate_nan)

    @staticmethod
    def minimum(x: Any, y: Any, propagate_nan: Any = None) -> Any:
        return _extreme("minimum", x, y, propagate_nan)

    def __getattr__(self, name: str) -> Any:
        if name in _UNARY:
            return lambda x: _unary(name, x)
        if name.startswith("__"):
            raise AttributeError(name)
        raise TraceError(f"`tl.{name}` cannot be traced")


_LANGUAGE = _TorchLanguage()
_UNARY: dict[str, Callable[[float], float]] = {
    "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "abs": builtins.abs, "sin": math.sin, "cos": math.cos,
    "floor": math.floor,
}  # fmt: skip
_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "<": operator.lt,
    "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
    "&": operator.and_, "|": operator.or_,
}  # fmt: skip


def _unary(name: str, x: Any) -> Any:
    if isinstance(x, Symbol):
        return x.graph.make(name, x)
    if name == "sqrt" and isinstance(x, Tensor) and x.requires_grad:  # its gradient is zero at zero
        return torch.where(x == 0, 0.0, torch.where(x == 0, 1.0, x).sqrt())
    return getattr(torch, name)(x) if isinstance(x, Tensor) else _UNARY[name](x)


def _extreme(name: str, x: Any, y: Any, propagate: Any = None) -> Any:
    graph = _graph_of(x, y)
    if graph is not None:
        return graph.make(name + ("_nan" if str(propagate).endswith("ALL") else ""), x, y)
    if isinstance(x, Tensor) and isinstance(y, Tensor):
        return getattr(torch, name)(x, y)
    if isinstance(x, Tensor) or isinstance(y, Tensor):
        tensor, number = (x, y) if isinstance(x, Tensor) else (y, x)
        return tensor.clamp(**{"min" if name == "maximum" else "max": number})
    return max(x, y) if name == "maximum" else min(x, y)


def _leaves(value: Any) -> Any:
    if isinstance(value, tuple):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


def _graph_of(*values: Any) -> Graph | None:
    return next((value.graph for value in values if isinstance(value, Symbol)), None)


# ---- symbols


class Symbol:
    """An unknown number: an operation and its arguments."""

    __slots__ = ("args", "graph", "index", "op")

    def __init__(self, graph: Graph, op: str, args: tuple[Any, ...], index: int) -> None:
        self.graph, self.op, self.args, self.index = graph, op, args, index

    def __hash__(self) -> int:
        return hash((id(self.graph), self.index))

    def __bool__(self) -> bool:
        raise TraceError("a condition must be constant: use `tl.where`")

    def __neg__(self) -> Any:
        return self.graph.make("-", 0.0, self)

    def __invert__(self) -> Any:
        return self.graph.make("==", self, False)


def _operation(op: str, swapped: bool) -> Callable[[Symbol, Any], Any]:
    if swapped:
        return lambda x, y: x.graph.make(op, y, x)
    return lambda x, y: x.graph.make(op, x, y)


for _op, _name in {"+": "add", "-": "sub", "*": "mul", "/": "truediv", "&": "and", "|": "or"}.items():
    setattr(Symbol, f"__{_name}__", _operation(_op, False))
    setattr(Symbol, f"__r{_name}__", _operation(_op, True))
for _op, _name in {"<": "lt", "<=": "le", ">": "gt", ">=": "ge", "==": "eq", "!=": "ne"}.items():
    setattr(Symbol, f"__{_name}__", _operation(_op, False))


class Graph:
    """All symbols of a trace; equal symbols are shared."""

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], Symbol] = {}

    def make(self, op: str, *args: Any) -> Any:
        """The symbol of an operation, or what it simplifies to."""
        simple = _simplified(op, args)
        if simple is not None:
            return simple
        if op in ("+", "*"):
            args = tuple(sorted(args, key=lambda a: (-1, a) if _number(a) else (a.index, 0.0)))
        key = (op, *map(_key, args))
        if key not in self._known:
            self._known[key] = Symbol(self, op, args, len(self._known))
        return self._known[key]

    def argument(self, name: str, shape: Shape) -> Any:
        if shape == 0:
            return self.make("argument", name)
        return tuple(self.make("argument", f"{name}[{k}]") for k in range(shape))

    def call(self, function: Any, known: Primitive, given: tuple[Any, ...]) -> Any:
        whole = self.make("call", function, given)

        def parts(shape: Any, place: str) -> Any:
            if shape == 0:
                return self.make("part", whole, place)
            shapes = (0,) * shape if isinstance(shape, int) else shape
            return tuple(parts(own, f"{place}[{k}]") for k, own in enumerate(shapes))

        return parts(known.outputs, "")


def _number(value: Any) -> bool:
    return isinstance(value, (bool, int, float))


def _zero(value: Any) -> bool:
    return _number(value) and value == 0


def _key(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_key, value))
    return ("symbol", value.index) if isinstance(value, Symbol) else (type(value).__name__, value)


def _same(x: Any, y: Any) -> bool:
    return _key(x) == _key(y)


def _simplified(op: str, args: tuple[Any, ...]) -> Any:
    if op in ("argument", "call", "part"):
        return None
    if all(map(_number, args)):
        if op in _BINARY:
            return _BINARY[op](*args)
        return getattr(_LANGUAGE, op.removesuffix("_nan"))(*args)
    if op == "where":
        condition, yes, no = args
        return (yes if condition else no) if _number(condition) else yes if _same(yes, no) else None
    if len(args) != 2:
        return None
    x, y = args
    zero, one = (_zero(x), _zero(y)), (_number(x) and x == 1, _number(y) and y == 1)
    match op:
        case "*" if _number(x) and isinstance(y, Symbol) and y.op == "*" and _number(y.args[0]):
            return y.graph.make("*", x * y.args[0], y.args[1])
        case "+" if any(zero):
            return y if zero[0] else x
        case "+" if any(
            _key(u) == _key(-1.0 * v) for u, v in ((x, y), (y, x)) if isinstance(u, Symbol) and u.op == "*"
        ):
            return 0.0
        case "-" if zero[1]:
            return x
        case "-" if _same(x, y):
            return 0.0
        case "*" if any(zero):
            return 0.0
        case "*" if any(one):
            return y if one[0] else x
        case "/" if zero[0]:
            return 0.0
        case "/" if one[1]:
            return x
    return None


# ---- derivatives


def gradient(outputs: Sequence[Any], inputs: Any, bars: Sequence[Any] | None = None) -> Any:
    """Gradients of the sum of some numbers, weighted with ``bars``, by the symbols ``inputs``, in their structure."""
    order = _order(outputs)
    bar: dict[Any, Any] = {}
    calls: dict[Symbol, dict[str, Any]] = {}

    def add(to: Any, value: Any) -> None:
        if isinstance(to, Symbol) and not _zero(value):
            bar[to.index] = bar[to.index] + value if to.index in bar else value

    wanted = {leaf.index for leaf in _leaves(inputs) if isinstance(leaf, Symbol)}
    for output, own in zip(outputs, [1.0] * len(outputs) if bars is None else bars, strict=True):
        add(output, own)
    for node in reversed(order):
        if node.op == "call":
            _pull_call(node, calls.get(node, {}), add)
        elif node.index in bar and node.index not in wanted:
            if node.op == "part":
                calls.setdefault(node.args[0], {})[node.args[1]] = bar[node.index]
            else:
                _pull(node, bar[node.index], add)

    def found(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(found, value))
        return bar.get(value.index, 0.0) if isinstance(value, Symbol) else 0.0

    return found(inputs)


def _order(outputs: Sequence[Any]) -> list[Symbol]:
    seen: set[int] = set()
    order: list[Symbol] = []
    pending: list[tuple[Any, bool]] = [(output, False) for output in reversed(list(_leaves(tuple(outputs))))]
    while pending:
        node, done = pending.pop()
        if not isinstance(node, Symbol) or (node.index in seen and not done):
            continue
        if done:
            order.append(node)
            continue
        seen.add(node.index)
        pending.append((node, True))
        pending += [(leaf, False) for leaf in reversed(list(_leaves(node.args)))]
    return order


def _pull(node: Symbol, g: Any, add: Callable[[Any, Any], None]) -> None:
    x, y = (*node.args, None)[:2]
    make = node.graph.make
    match node.op:
        case "+":
            add(x, g)
            add(y, g)
        case "-":
            add(x, g)
            add(y, -g)
        case "*":
            add(x, g * y)
            add(y, g * x)
        case "/":
            add(x, g / y)
            add(y, -(g * node / y))
        case "sqrt":
            add(x, 0.5 * g / make("maximum", node, 1e-30))
        case "exp":
            add(x, g * node)
        case "log":
            add(x, g / x)
        case "sin":
            add(x, g * make("cos", x))
        case "cos":
            add(x, -(g * make("sin", x)))
        case "abs":
            add(x, make("where", make("<", x, 0.0), -g, g))
        case "maximum" | "maximum_nan" | "minimum" | "minimum_nan":
            first = make(">" if node.op[:2] == "ma" else "<", x, y)
            add(x, make("where", first, g, 0.0))
            add(y, make("where", first, 0.0, g))
        case "where":
            add(node.args[1], make("where", x, g, 0.0))
            add(node.args[2], make("where", x, 0.0, g))
        case "argument" | "floor" | "<" | "<=" | ">" | ">=" | "==" | "!=" | "&" | "|":
            pass
        case _:
            raise TraceError(f"`{node.op}` has no derivative")


def _pull_call(node: Symbol, bars: dict[str, Any], add: Callable[[Any, Any], None]) -> None:
    function, given = node.args
    known = _PRIMITIVES[function]
    if not bars:
        return
    if known.vjp is None:
        raise TraceError(f"{function.fn.__module__}.{function.fn.__name__} has no derivative")
    result = node.graph.call(function, known, given)

    def own(part: Any) -> Any:
        return tuple(map(own, part)) if isinstance(part, tuple) else bars.get(part.args[1], 0.0)

    found = known.vjp(given, result, own(result))
    for to, value in zip(_leaves(given), _leaves(found), strict=True):
        add(to, value)


def tangent(outputs: Sequence[Any], inputs: Sequence[Any], directions: Sequence[Any]) -> tuple[Any, ...]:
    """Derivatives of some numbers in a direction: the transpose of :func:`gradient`, which is linear in its bars."""
    graph = _graph_of(*_leaves(tuple(outputs)))
    if graph is None:
        return (0.0,) * len(outputs)
    bars = [graph.make("argument", f"bar {k}") for k in range(len(outputs))]
    by = gradient(outputs, tuple(inputs), bars)
    return gradient(by, tuple(bars), directions)


def difference(output: Any, inputs: Sequence[Symbol], others: Sequence[Any], steps: Sequence[float], gap: Any) -> Any:
    """(f(x) - f(y)) / gap without cancellation, from f(x) and y.

    Args:
        steps: The entries of x - y as multiples of the gap.
    """
    order = _order([output])
    there: dict[int, Any] = {}
    change: dict[int, Any] = {}
    for x, y, step in zip(inputs, others, steps, strict=True):
        there[x.index], change[x.index] = y, step

    def at(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(at, value))
        return there.get(value.index, value) if isinstance(value, Symbol) else value

    def by(value: Any) -> Any:
        return change.get(value.index, 0.0) if isinstance(value, Symbol) else 0.0

    for node in order:
        if node.index in there or node.op in ("argument", "call"):
            continue
        if node.op == "part":
            function, given = node.args[0].args
            if all(_zero(by(leaf)) for leaf in _leaves(given)):
                continue
            known = _PRIMITIVES[function]
            if known.difference is None:
                raise TraceError(f"{function.fn.__module__}.{function.fn.__name__} has no divided difference")
            there[node.index] = node.graph.call(function, known, at(given))
            change[node.index] = by(given[0]) * known.difference(given[0], at(given[0]))
            continue
        moves = [by(value) for value in node.args]
        compared = node.op in ("<", "<=", ">", ">=", "==", "!=", "&", "|")
        if all(map(_zero, moves)) and all(_same(value, at(value)) for value in node.args):
            continue
        there[node.index] = node.graph.make(node.op, *map(at, node.args))
        if compared or _same(there[node.index], node):  # symmetric
            continue
        change[node.index] = _moved(node, moves, at, there[node.index], gap)
    return by(output)


def _moved(node: Symbol, moves: list[Any], at: Callable[[Any], Any], end: Any, gap: Any) -> Any:
    x, y = (*node.args, None)[:2]
    make = node.graph.make
    match node.op:
        case "+":
            return moves[0] + moves[1]
        case "-":
            return moves[0] - moves[1]
        case "*":
            return moves[0] * y + at(x) * moves[1]
        case "/":
            return (moves[0] - end * moves[1]) / y
        case "sqrt":
            return moves[0] / make("maximum", node + end, 1e-30)
        case "maximum" | "minimum" if _number(y) or _same(at(y), y):
            share = _share_above(x, at(x), y)
            return moves[0] * (share if node.op == "maximum" else 1.0 - share)
        case "maximum" | "minimum" if _number(x) or _same(at(x), x):
            share = _share_above(y, at(y), x)
            return moves[1] * (share if node.op == "maximum" else 1.0 - share)
        case "log" | "exp":
            d = x - at(x)
            if node.op == "log":  # 2 artanh of the ratio
                ratio = d / (x + at(x))
                w = ratio * ratio
                near = w < 0.04
                series = 2 * (1 + w * (1 / 3 + w * (1 / 5 + w * (1 / 7 + w * (1 / 9 + w / 11))))) / (x + at(x))
            else:
                near = make("abs", d) < 0.1
                series = end * (1 + d * (1 / 2 + d * (1 / 6 + d * (1 / 24 + d * (1 / 120 + d / 720)))))
            return moves[0] * make("where", near, series, (node - end) / make("where", near, 1.0, d))
        case "where":
            one = make("where", x, moves[1], moves[2])
            jump = (node - end) / make("where", make("==", gap, 0.0), 1.0, gap)
            return make("where", make("==", x, at(x)), one, jump)
        case "abs":
            return moves[0] * (x + at(x)) / make("maximum", node + end, 1e-30)
    raise TraceError(f"`{node.op}` has no divided difference")


def _share_above(x: Any, y: Any, floor: Any) -> Any:
    make, gap = x.graph.make, x - y
    none = make("==", gap, 0.0)
    above = (make("maximum", x, floor) - make("maximum", y, floor)) / make("where", none, 1.0, gap)
    return make("where", none, make("where", make("<", x, floor), 0.0, 1.0), above)


# ---- new device functions


def device_function(name: str, shapes: dict[str, Shape], formula: Callable[..., Any]) -> Any:
    """A device function from a formula of symbols.

    Args:
        shapes: The shapes of its arguments, by name.
        formula: Takes the symbols and returns a number or a tuple; it may call ``on_tensors(function)``.
    """
    graph = Graph()
    result = formula(*(graph.argument(key, shape) for key, shape in shapes.items()))
    body, known = _body(result)
    arguments = ", ".join(shapes)
    called = sorted((key, value.fn.__module__) for key, value in known.items())
    full = f"{name}_{hashlib.sha256(repr((arguments, body, called)).encode()).hexdigest()[:12]}"
    source = f"@triton.jit\ndef {full}({arguments}):\n{body}\n"
    file = f"<{__name__}.{full}>"
    linecache.cache[file] = (len(source), None, source.splitlines(True), file)
    scope = {"tl": tl, "triton": triton, **known, "__name__": __name__}
    exec(compile(source, file, "exec"), scope)
    return scope[full]


def _body(result: Any) -> tuple[str, dict[str, Any]]:
    names: dict[int, str] = {}
    known: dict[str, Any] = {}
    lines: list[str] = []

    def text(value: Any) -> str:
        if isinstance(value, tuple):
            return "(" + "".join(f"{text(part)}, " for part in value) + ")"
        if isinstance(value, Symbol):
            return names[value.index]
        return f'float("{value}")' if isinstance(value, float) and not math.isfinite(value) else repr(value)

    for node in _order([result]):
        if node.op == "argument":
            names[node.index] = node.args[0]
            continue
        if node.op == "part":
            names[node.index] = text(node.args[0]) + node.args[1]
            continue
        names[node.index] = f"t{len(lines)}"
        lines.append(f"    t{len(lines)} = {_written(node, text, known)}")
    return "\n".join([*lines, f"    return {text(result)}"]), known


def _written(node: Symbol, text: Callable[[Any], str], known: dict[str, Any]) -> str:
    if node.op == "call":
        function, given = node.args
        name = function.fn.__name__
        while known.setdefault(name, function) is not function:
            name += "_"
        return f"{name}({', '.join(map(text, given))})"
    values = [text(value) for value in node.args]
    if node.op == "-" and _zero(node.args[0]):
        return f"-{values[1]}"
    if node.op in _BINARY:
        return f"{values[0]} {node.op} {values[1]}"
    if node.op.endswith("_nan"):
        return f"tl.{node.op[:-4]}({', '.join(values)}, tl.PropagateNan.ALL)"
    return f"tl.{node.op}({', '.join(values)})"


def vjp(function: Any, shapes: dict[str, Shape], by: Sequence[str], constants: dict[str, Any] | None = None) -> Any:
    """The adjoint of a device function, as a device function of its arguments and of ``bar``.

    ``bar`` has the structure of the result, as one flat tuple (a number if the result is one). The adjoint returns the
    gradients of its product with the result, a tuple with one entry for each name in ``by``, in the shape of the
    argument.

    Args:
        shapes: Shapes of the arguments that are numbers, by name.
    """
    graph = Graph()
    given = {key: graph.argument(key, shape) for key, shape in shapes.items()}
    single = isinstance(on_tensors(function)(**given, **(constants or {})), Symbol)
    many = len(list(_leaves(on_tensors(function)(**given, **(constants or {})))))

    def formula(*arguments: Any) -> Any:
        *own, bar = arguments
        named = dict(zip(shapes, own, strict=True))
        result = on_tensors(function)(**named, **(constants or {}))
        bars = [bar] if single else list(bar)
        return gradient(list(_leaves(result)), tuple(named[key] for key in by), bars)

    return device_function(f"{function.fn.__name__}_adjoint", {**shapes, "bar": 0 if single else many}, formula)


def uses(function: Any, shapes: dict[str, Shape]) -> set[str]:
    """Names of the arguments that affect the result of a device function."""
    graph = Graph()
    result = on_tensors(function)(**{key: graph.argument(key, shape) for key, shape in shapes.items()})
    return {node.args[0].split("[")[0] for node in _order([result]) if node.op == "argument"}


class _Unknown(Symbol):
    """An argument that may be a number or a tuple."""

    __slots__ = ()

    def __getitem__(self, k: int) -> Any:
        return self.graph.make("argument", f"{self.args[0]}[{k}]")

    def __iter__(self) -> Any:
        raise TraceError("how many numbers an argument has is not known")


def canonical(function: Any) -> str:
    """A canonical text of a device function: the same for the same formula, whatever its names.

    Raises:
        TraceError: If it cannot be traced.
    """
    graph = Graph()
    names = inspect.signature(function.fn).parameters
    given = [_Unknown(graph, "argument", (f"argument {k}",), -1 - k) for k in range(len(names))]
    try:
        return _body(on_tensors(function, look_in=True)(*given))[0]
    except (TypeError, AttributeError) as error:
        raise TraceError(str(error)) from error


def text_of(function: Any) -> str:
    """The source of a device function, derived ones too."""
    return "".join(inspect.getsourcelines(function.fn)[0])


__all__ = [
    "Memory", "Primitive", "Symbol", "TraceError", "canonical", "device_function", "difference", "gradient",
    "on_tensors", "primitive", "tangent", "text_of", "uses", "vjp",
]  # fmt: skip
