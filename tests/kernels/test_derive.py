import pytest
import torch
from shared import double, rand, randn, seeded

from gaussian_swaying.kernels.derive import (
    Memory,
    TraceError,
    device_function,
    difference,
    gradient,
    on_tensors,
    primitive,
    tangent,
    text_of,
    vjp,
)
from gaussian_swaying.kernels.language import tl, triton

LEAST = tl.constexpr(0.05)


@triton.jit
def root(x):
    return tl.sqrt(x)


primitive(
    root, vjp=lambda given, result, bar: (bar / (2 * result),), difference=lambda x, y: 1 / (root_of(x) + root_of(y))
)
root_of = on_tensors(root)


@triton.jit
def formula(a, s, p, SQUARED: tl.constexpr):
    zero = 0.0 * s
    total = zero
    for k in tl.static_range(3):
        total += tl.maximum(a[k], LEAST) * tl.exp(-a[k])
    if SQUARED:
        total = total * total
    chosen = tl.where((s > 0) & (a[0] < 2.0), tl.log(tl.abs(s) + 1), tl.minimum(s, a[1]))
    wave = tl.sin(a[2]) - tl.cos(s / p[0])
    return total + zero + root(a[0] * a[0] + 1), (chosen, wave)


@triton.jit
def branching(x, y):
    if x > 0:
        y = -y
    return y


@triton.jit
def loading(x):
    return tl.load(x)


def _inputs(count=50):
    draw = seeded(0)
    return randn(5, count, generator=draw).requires_grad_()


def _result(x):
    total, (chosen, wave) = on_tensors(formula)(tuple(x[:3]), x[3], (2.0,), True)
    return torch.stack([total, chosen, wave])


def test_a_device_function_is_its_definition_in_torch():
    x = _inputs()
    a, s = x[:3], x[3]
    total = (a.clamp(min=0.05) * (-a).exp()).sum(0).square() + (a[0].square() + 1).sqrt()
    chosen = torch.where((s > 0) & (a[0] < 2), (s.abs() + 1).log(), torch.minimum(s, a[1]))
    expected = torch.stack([total, chosen, a[2].sin() - (s / 2).cos()])
    torch.testing.assert_close(_result(x), expected)
    single = _result(x.float())
    assert single.dtype == torch.float32
    assert on_tensors(formula)((1.0, 2.0, 3.0), 4.0, (2.0,), False)[1][0] == pytest.approx(
        float(torch.tensor(5.0).log())
    )


def test_the_adjoint_is_the_gradient():
    x, bar = _inputs(), randn(3, 50)
    (expected,) = torch.autograd.grad((_result(x) * bar).sum(), x)
    adjoint = vjp(formula, {"a": 3, "s": 0}, ("a", "s"), {"p": (2.0,), "SQUARED": True})
    by_a, by_s = on_tensors(adjoint)(tuple(x.detach()[:3]), x.detach()[3], tuple(bar))
    torch.testing.assert_close(torch.stack([*by_a, by_s]), expected[:4])
    assert text_of(adjoint) == text_of(vjp(formula, {"a": 3, "s": 0}, ("a", "s"), {"p": (2.0,), "SQUARED": True}))


def test_a_tangent_is_the_transpose():
    def both(a, t):
        results = (a[0] * a[1] / a[2], on_tensors(root)(a[0]))
        return tangent(results, a, t), gradient(results, a, (t[0], t[1]))

    function = on_tensors(device_function("both", {"a": 3, "t": 3}, both))
    a, t = (rand(3, 20) + 0.5 for _ in range(2))
    forward = function(tuple(a), tuple(t))[0]
    _, expected = torch.func.jvp(lambda a: torch.stack([a[0] * a[1] / a[2], a[0].sqrt()]), (a,), (t,))
    torch.testing.assert_close(torch.stack(forward), expected)
    along = sum(d * v for d, v in zip(forward, t[:2], strict=True))
    back = sum(d * v for d, v in zip(function(tuple(a), tuple(t))[1], t, strict=True))
    torch.testing.assert_close(along, back)


def test_a_divided_difference_does_not_cancel():
    """(f(x, y) - f(y, x)) / (x - y) to round-off, also for close and equal numbers."""

    def slope(x, y):
        value = on_tensors(root)(x * x + 3.0 * y) / on_tensors(largest)(x, 0.5) - on_tensors(bent)(x)
        return difference(value, (x, y), (y, x), (1.0, -1.0), x - y)

    @triton.jit
    def largest(x, floor):
        return tl.maximum(x, floor)

    @triton.jit
    def bent(x):
        return tl.where(x > 0.6, 2 * x, x + 0.6)

    function = on_tensors(device_function("slope", {"x": 0, "y": 0}, slope))
    x = double([0.7, 0.7, 0.3, 0.7, 2.0])
    y = x + double([0.5, 1e-9, 0.1, 0.0, -1.7])

    def f(x, y):
        return (x * x + 3 * y).sqrt() / x.clamp(min=0.5) - torch.where(x > 0.6, 2 * x, x + 0.6)

    quotient = (f(x, y) - f(y, x)) / torch.where(x == y, 1.0, x - y)
    by = torch.func.grad(lambda x, y: f(x, y).sum(), (0, 1))(x, y)
    expected = torch.where((x - y).abs() < 1e-6, by[0] - by[1], quotient)
    torch.testing.assert_close(function(x, y), expected, rtol=1e-7, atol=1e-9)


@triton.jit
def looked_up(table, x, mask, STEP: tl.constexpr):
    first = table + tl.floor(x).to(tl.int32) * STEP
    return tl.load(first, mask, -1.0), tl.load(first + 1, mask, -1.0)


def test_tables_are_looked_up():
    x, table = double([0.5, 1.2, 7.0]), torch.arange(5)
    found = torch.stack(on_tensors(looked_up)(Memory(table), x, x < 3, 2))
    assert torch.equal(found, double([[0.0, 2.0, -1.0], [1.0, 3.0, -1.0]]))


def test_the_gradient_of_a_length_is_zero_at_zero():
    x = torch.tensor([0.0, 4.0], requires_grad=True)
    (found,) = torch.autograd.grad(on_tensors(length)(x).sum(), x)
    assert found.tolist() == [0.0, 1.0]


@triton.jit
def length(x):
    return tl.sqrt(x * x)


def test_what_cannot_be_traced_is_refused_with_its_line():
    x = torch.ones(3)
    line = branching.fn.__code__.co_firstlineno + 2
    with pytest.raises(TraceError, match=rf"branching, line {line}: a condition must be constant"):
        on_tensors(branching)(x, x)
    with pytest.raises(TraceError, match=r"loading, line \d+: `tl.load` cannot be traced"):
        on_tensors(loading)(x)
    with pytest.raises(TraceError, match="has no derivative"):
        vjp(quiet_caller, {"x": 0}, ("x",))


@triton.jit
def quiet(x):
    return x


@triton.jit
def quiet_caller(x):
    return quiet(x)


primitive(quiet)
