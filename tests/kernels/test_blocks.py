"""Operations on blocks, one at a time in a small kernel, against torch; for one lane and for eight."""

import math

import numpy as np
import pytest
import torch
from shared import rand, randn, seeded
from torch.testing import assert_close

from gaussian_swaying.kernels.blocks import TranslationError
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import launch

NAN, INF = math.nan, math.inf


@triton.jit
def _one(x, y, NAME: tl.constexpr):
    """An operation by its name."""
    if NAME == "add":
        return x + y
    if NAME == "subtract":
        return x - y
    if NAME == "multiply":
        return x * y
    if NAME == "divide":
        return x / y
    if NAME == "divide exactly":
        return tl.div_rn(x, y)
    if NAME == "quotient":
        return x // y
    if NAME == "remainder":
        return x % y
    if NAME == "and":
        return x & y
    if NAME == "or":
        return x | y
    if NAME == "xor":
        return x ^ y
    if NAME == "left":
        return x << (y & 7)
    if NAME == "right":
        return x >> (y & 7)
    if NAME == "negative":
        return -x
    if NAME == "inverted":
        return ~x
    if NAME == "absolute":
        return tl.abs(x)
    if NAME == "larger":
        return tl.maximum(x, y)
    if NAME == "smaller":
        return tl.minimum(x, y)
    if NAME == "larger or NaN":
        return tl.maximum(x, y, propagate_nan=tl.PropagateNan.ALL)
    if NAME == "smaller or NaN":
        return tl.minimum(x, y, propagate_nan=tl.PropagateNan.ALL)
    if NAME == "chosen":
        return tl.where(x > 0, x, y)
    if NAME == "root":
        return tl.sqrt(tl.abs(x))
    if NAME == "exponential":
        return tl.exp(x)
    if NAME == "logarithm":
        return tl.log(tl.abs(x))
    if NAME == "plain logarithm":
        return tl.log(x)
    if NAME == "sine":
        return tl.sin(x)
    if NAME == "cosine":
        return tl.cos(x)
    if NAME == "floored":
        return tl.floor(x)
    if NAME == "int32":
        return x.to(tl.int32)
    if NAME == "int64":
        return x.to(tl.int64)
    if NAME == "float32":
        return x.to(tl.float32)
    if NAME == "float64":
        return x.to(tl.float64)
    if NAME == "truth":
        return x.to(tl.int1)
    if NAME == "signs":
        found = tl.where(x < y, 1, 0) | tl.where(x <= y, 2, 0) | tl.where(x > y, 4, 0)
        return found | tl.where(x >= y, 8, 0) | tl.where(x == y, 16, 0) | tl.where(x != y, 32, 0)
    if NAME == "logic":
        a, b = x > 0, y > 0
        found = tl.where(a & b, 1, 0) | tl.where(a | b, 2, 0) | tl.where(a ^ b, 4, 0) | tl.where(~a, 8, 0)
        found = found | tl.where(not b, 16, 0) | tl.where(a and b, 32, 0) | tl.where(a or b, 64, 0)
        return found | ((a + b) << 7)
    if NAME == "beside a float":
        return x + 0.1
    return x + 1099511627776


@triton.jit
def _apply(x_in, y_in, out, count, NAMES: tl.constexpr, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < count
    for row in tl.static_range(len(NAMES)):
        value = _one(tl.load(x_in + k, mask), tl.load(y_in + k, mask, 1), NAMES[row])
        tl.store(out + row * count + k, value, mask)


def _rows(names, x, y, kind, block):
    """What each operation gives, all by one kernel."""
    out = torch.full((len(names), len(x)), 77, dtype=kind)
    launch(_apply, (-(-len(x) // block),))(x, y, out, len(x), NAMES=tuple(names), BLOCK=block)
    return zip(out, names.values() if isinstance(names, dict) else names, strict=True)


def _applied(name, x, y, kind, block):
    ((found, _),) = _rows([name], x, y, kind, block)
    return found


@pytest.fixture(params=[1, 8])
def block(request):
    """Lanes of a program; 19 numbers are no multiple of them."""
    return request.param


def _whole(kind):
    draw = seeded(0)
    x, y = torch.randint(-90, 90, (2, 19), generator=draw, dtype=kind)
    x[:4], y[:4] = torch.tensor([7, -7, 7, -7]), torch.tensor([2, 2, -2, -2])
    return x, torch.where(y == 0, 3, y)


def _real(kind):
    x, y = torch.randn(2, 19, generator=seeded(0), dtype=kind)
    x[:7] = torch.tensor([NAN, 1.0, NAN, INF, -INF, 0.0, 2.0])
    y[:7] = torch.tensor([1.0, NAN, NAN, -INF, 3.0, -0.0, 2.0])
    return x, y


def _same(found, expected):
    assert_close(found, expected, rtol=0, atol=0, equal_nan=True)


# ---- numbers


BOTH = {
    "add": torch.add,
    "subtract": torch.sub,
    "multiply": torch.mul,
    "negative": lambda x, y: -x,
    "absolute": lambda x, y: x.abs(),
}
WHOLE = BOTH | {
    "quotient": lambda x, y: torch.div(x, y, rounding_mode="trunc"),  # as in C, and in Triton
    "remainder": torch.fmod,
    "and": torch.bitwise_and,
    "or": torch.bitwise_or,
    "xor": torch.bitwise_xor,
    "left": lambda x, y: x << (y & 7),
    "right": lambda x, y: x >> (y & 7),
    "inverted": lambda x, y: ~x,
    "larger": torch.maximum,
    "smaller": torch.minimum,
}
REAL = BOTH | {
    "divide": torch.div,
    "divide exactly": torch.div,
    "larger": torch.fmax,
    "smaller": torch.fmin,
    "larger or NaN": torch.maximum,
    "smaller or NaN": torch.minimum,
    "chosen": lambda x, y: torch.where(x > 0, x, y),
}


@pytest.mark.parametrize("kind", [torch.int32, torch.int64, torch.float32, torch.float64], ids=str)
def test_operations(kind, block):
    x, y = _real(kind) if kind.is_floating_point else _whole(kind)
    for found, expected in _rows(REAL if kind.is_floating_point else WHOLE, x, y, kind, block):
        _same(found, expected(x, y))


def test_integers_wrap(block):
    x = torch.full((9,), 2**31 - 1, dtype=torch.int32)
    _same(_applied("add", x, x, torch.int32, block), torch.full_like(x, -2))
    _same(_applied("add", x, x, torch.int64, block), torch.full((9,), -2))  # converted afterwards
    wide = x.long()
    _same(_applied("add", wide, x, torch.int64, block), torch.full((9,), 2**32 - 2))


def test_a_negative_zero_is_kept(block):
    zero = torch.zeros(9)
    assert torch.signbit(_applied("negative", zero, zero, torch.float32, block)).all()


FUNCTIONS = {
    "root": lambda x: x.abs().sqrt(),
    "exponential": torch.exp,
    "logarithm": lambda x: x.abs().log(),
    "sine": torch.sin,
    "cosine": torch.cos,
    "floored": torch.floor,
}


@pytest.mark.parametrize("kind", [torch.float32, torch.float64], ids=str)
def test_functions(kind, block):
    """To two units in the last place; those of integers are floating point numbers."""
    x = torch.linspace(-20, 20, 43, dtype=torch.float64).to(kind)
    for found, exact in _rows(FUNCTIONS, x, x, kind, block):
        rtol = 2 * torch.finfo(kind).eps
        assert_close(found.double(), exact(x.double()), rtol=rtol, atol=1e-300)
    whole = torch.arange(-9, 10, dtype=torch.int32)
    for found, exact in _rows(FUNCTIONS, whole, whole, torch.float32, block):
        assert_close(found.double(), exact(whole.double()), rtol=3e-7, atol=1e-12)


def _off(name, x):
    """The error of a function of float32, in units of the last place of the exact value."""
    found, exact = _applied(name, x, x, torch.float32, 8).numpy(), FUNCTIONS[name](x.double()).numpy()
    return np.abs(found - exact) / np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)


def test_exp_and_log_are_within_two_units_of_the_last_place():
    x = torch.cat([torch.linspace(-104, 88.72, 400_001), torch.linspace(-1, 1, 100_001), torch.tensor([1e-30, -1e-30])])
    assert _off("exponential", x).max() < 2
    draw = seeded(1)
    wide, near, nearest = (rand(n, generator=draw) for n in (400_000, 200_000, 1000))
    x = torch.cat([(191.7 * wide - 103).exp(), 0.5 + 1.5 * near, 1 + 1e-6 * nearest.mul(6).sub(3)]).float()
    x = x[x > 0]
    assert (x < 2.0**-126).sum() > 1000
    assert _off("logarithm", x).max() < 2


def test_special_numbers_of_exp_and_log(block):
    x = torch.tensor([0.0, -0.0, INF, -INF, NAN, 1.0, 100.0, -110.0, 3e38, -3e38, -1.0])
    expected = torch.tensor([1, 1, INF, 0, NAN, math.e, INF, 0, INF, 0, 1 / math.e])
    _same(_applied("exponential", x, x, torch.float32, block), expected)
    x = torch.tensor([0.0, -0.0, INF, -INF, NAN, 1.0, 100.0, 3e38, -1.0])
    expected = torch.tensor([-INF, -INF, INF, NAN, NAN, 0, math.log(100), math.log(x[7]), NAN])
    _same(_applied("plain logarithm", x, x, torch.float32, block), expected)


# ---- comparisons and truth


@pytest.mark.parametrize("kind", [torch.int32, torch.int64, torch.float32, torch.float64], ids=str)
def test_comparisons(kind, block):
    x, y = _real(kind) if kind.is_floating_point else _whole(kind)
    x[7] = y[7]
    found = torch.stack([x < y, x <= y, x > y, x >= y, x == y, x != y])
    bits = 2 ** torch.arange(6, dtype=torch.int32)[:, None]
    _same(_applied("signs", x, y, torch.int32, block), (found * bits).sum(0, dtype=torch.int32))


def test_logic(block):
    x, y = torch.tensor([1, 1, -1, -1] * 3, dtype=torch.int32), torch.tensor([1, -1, 1, -1] * 3, dtype=torch.int32)
    a, b = x > 0, y > 0
    rows = torch.stack([a & b, a | b, a ^ b, ~a, ~b, a & b, a | b]).int()
    bits = 2 ** torch.arange(7, dtype=torch.int32)[:, None]
    expected = (rows * bits).sum(0, dtype=torch.int32) + 128 * (a.int() + b.int())
    _same(_applied("logic", x, y, torch.int32, block), expected)


# ---- types


def test_floats_become_the_nearest_integers(block):
    """Towards zero; NaN is 0, and what is too large the largest."""
    x = torch.tensor([1.9, -1.9, 3e9, -3e9, 1e30, INF, -INF, NAN, 0.4])
    low, high = -(2**31), 2**31 - 1
    expected = torch.tensor([1, -1, high, low, high, high, low, 0, 0], dtype=torch.int32)
    _same(_applied("int32", x, x, torch.int32, block), expected)
    low, high = -(2**63), 2**63 - 1
    expected = torch.tensor([1, -1, 3_000_000_000, -3_000_000_000, high, high, low, 0, 0])
    _same(_applied("int64", x, x, torch.int64, block), expected)


def test_conversions(block):
    whole = torch.tensor([0, 1, -1, 2**31 + 5, -(2**40) - 3, 7, 8, 9, 10])
    _same(_applied("int32", whole, whole, torch.int32, block), whole.int())
    _same(_applied("float32", whole, whole, torch.float32, block), whole.float())
    _same(_applied("float64", whole, whole, torch.float64, block), whole.double())
    real = torch.tensor([0.0, -0.0, NAN, INF, 0.1, 1e-40, -3.0, 2.0, 1e30])
    _same(_applied("float64", real, real, torch.float64, block), real.double())
    _same(_applied("float32", real.double() / 3, real, torch.float32, block), (real.double() / 3).float())
    _same(_applied("truth", real, real, torch.bool, block), real != 0)
    truth = torch.tensor([True, False] * 5)
    _same(_applied("float32", truth, truth, torch.float32, block), truth.float())
    _same(_applied("int64", truth, truth, torch.int64, block), truth.long())  # 1, not -1
    small = torch.tensor([-3, 5, 127, -128, 0, 1, 2, 3, 4], dtype=torch.int8)
    _same(_applied("int32", small, small, torch.int32, block), small.int())


def test_a_number_takes_the_type_of_the_block(block):
    """So 0.1 is one of float64 beside such a block, and 2^40 no integer of 32 bits."""
    x = torch.arange(9)
    _same(_applied("beside a float", x.double(), x, torch.float64, block), x.double() + 0.1)
    _same(_applied("beside a float", x.int(), x, torch.float32, block), x.float() + 0.1)
    _same(_applied("beside a large integer", x.int(), x, torch.int64, block), x + 2**40)
    third = x.double() / 3
    _same(_applied("multiply", x.int(), third, torch.float64, block), x * third)
    _same(_applied("multiply", third.float(), third, torch.float64, block), third.float().double() * third)


# ---- over all lanes


@triton.jit
def _reduce(x_in, sums, most, least, running, BLOCK: tl.constexpr):
    program = tl.program_id(0)
    k = program * BLOCK + tl.arange(0, BLOCK)
    x = tl.load(x_in + k)
    tl.store(sums + program, tl.sum(x))
    tl.store(most + program, tl.max(x, 0))
    tl.store(least + program, tl.min(x, axis=0))
    tl.store(running + k, tl.cumsum(x, 0))


@pytest.mark.parametrize("kind", [torch.int32, torch.int64, torch.float32, torch.float64], ids=str)
def test_sums_and_extremes(kind, block):
    x = (100 * randn(24, generator=seeded(0))).to(kind)
    sums, most, least = x.new_zeros(3, 24 // block)
    running = torch.zeros_like(x)
    launch(_reduce, (24 // block,))(x, sums, most, least, running, BLOCK=block)
    rows = x.reshape(-1, block)
    halves = rows
    while halves.shape[1] > 1:  # a fixed order
        half = halves.shape[1] // 2
        halves = halves[:, :half] + halves[:, half:]
    _same(sums, halves[:, 0])
    _same(most, rows.amax(1))
    _same(least, rows.amin(1))
    assert_close(running, rows.cumsum(1).reshape(-1).to(kind))


@triton.jit
def _count_all(x_in, out, BLOCK: tl.constexpr):
    tl.store(out, tl.sum(tl.load(x_in + tl.arange(0, BLOCK)) > 0))


def test_a_sum_of_truths_counts(block):
    x = torch.tensor([1.0, -1.0, 2.0, 3.0, -4.0, 5.0, -6.0, 7.0])
    out = torch.zeros(1, dtype=torch.int32)
    launch(_count_all, (1,))(x, out, BLOCK=block)
    assert int(out) == (x[:block] > 0).sum()


# ---- memory


@triton.jit
def _places(x_in, out, n, one, BLOCK: tl.constexpr):
    lane = tl.arange(0, BLOCK)
    row = out + lane
    tl.store(row, tl.load(x_in + 2 + lane))
    tl.store(row + BLOCK, tl.load(x_in + 3 * lane))
    tl.store(row + 2 * BLOCK, tl.load(x_in + lane * n))
    tl.store(row + 3 * BLOCK, tl.load(x_in + (BLOCK - 1) - lane))
    tl.store(row + 4 * BLOCK, tl.load(x_in + (2 * lane - lane)))
    tl.store(row + 5 * BLOCK, tl.load(x_in + n) + 0 * tl.load(x_in + lane))
    tl.store(row + 6 * BLOCK, tl.load(x_in + (lane.to(tl.int64) + n) * one))
    tl.store(row + 7 * BLOCK, tl.load(x_in + lane // 2))
    tl.store(row + 8 * BLOCK, tl.load(x_in + (lane ^ 1)))
    tl.store(row + 9 * BLOCK, tl.load(x_in + n + (lane - n)))


def test_where_loads_read(block):
    x, out = torch.randn(40), torch.zeros(10, block)
    launch(_places, (1,))(x, out, 3, 1, BLOCK=block)
    k = torch.arange(block)
    places = [k + 2, 3 * k, 3 * k, block - 1 - k, k, 0 * k + 3, k + 3, k // 2, k ^ 1, k]
    for row, place in zip(out, places, strict=True):
        _same(row, x[place])


@triton.jit
def _masked(x_in, n, first, strided, scattered, single, missing, BLOCK: tl.constexpr):
    lane = tl.arange(0, BLOCK)
    mask = lane < n
    far = tl.where(mask, lane, 1000000000)  # nothing is there
    tl.store(first + far, tl.load(x_in + far, mask, -1.0), mask)
    tl.store(first + BLOCK + lane, tl.load(x_in + lane, mask, -1.0))
    tl.store(first + 2 * BLOCK + lane, tl.load(x_in + 2 * lane, mask))  # zero by default
    tl.store(strided + 2 * lane, tl.load(x_in + lane, mask, 5.0), mask)
    tl.store(scattered + (lane ^ 1), lane + 1.0, mask)
    tl.store(first + 3 * BLOCK + lane, lane + 1.0, mask)
    tl.store(single, tl.load(missing + 1000000000, n < 0, 3.0), n > 0)
    tl.store(missing + 1000000000, 1.0, n < 0)
    tl.store(single + 1, tl.load(x_in + n, n > 0))


@pytest.mark.parametrize("n", [1, 5, 8])
def test_masks(n, block):
    x, out = torch.randn(16), torch.full((4, block), 77.0)
    strided, scattered, single = torch.full((16,), 77.0), torch.full((block + 1,), 77.0), torch.zeros(2)
    launch(_masked, (1,))(x, n, out, strided, scattered, single, torch.zeros(1), BLOCK=block)
    k = torch.arange(block)
    mask = k < n
    _same(out[0], torch.where(mask, x[:block], 77.0))
    _same(out[1], torch.where(mask, x[:block], -1.0))
    _same(out[2], torch.where(mask, x[2 * k], 0.0))
    _same(out[3], torch.where(mask, k + 1.0, 77.0))
    expected = torch.full((16,), 77.0)
    expected[2 * k[mask]] = x[k[mask]]
    _same(strided, expected)
    expected = torch.full((block + 1,), 77.0)
    expected[k[mask] ^ 1] = k[mask] + 1.0
    _same(scattered, expected)
    assert single.tolist() == [3.0, float(x[n])]


@triton.jit
def _truth(given, out, n, BLOCK: tl.constexpr):
    lane = tl.arange(0, BLOCK)
    found = tl.load(given + lane, lane < n)
    tl.store(out + lane, ~found)
    tl.store(out + BLOCK + lane, found & (lane > 1))
    tl.store(out + 2 * BLOCK, tl.load(given + 1))
    tl.store(out + 2 * BLOCK + 1, n)


def test_tensors_of_truth(block):
    given, out = torch.tensor([True, False, True, True, False, False, True, True]), torch.zeros(18, dtype=torch.bool)
    launch(_truth, (1,))(given, out, 7, BLOCK=block)
    seen = given[:block] & (torch.arange(block) < 7)
    expected = [*(~seen).tolist(), *(seen & (torch.arange(block) > 1)).tolist(), False, True]
    assert out[: 2 * block + 2].tolist() == expected
    assert out.view(torch.uint8)[: 2 * block + 2].tolist() == list(map(int, expected))
    assert not out[2 * block + 2 :].any()


# ---- atomic operations


@triton.jit
def _atomics(real, whole, before, where, value, n, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < n
    place = tl.load(where + k, mask, 1000000000)
    number = tl.load(value + k, mask, 0.0)
    tl.atomic_add(real + place, number, mask)
    tl.atomic_max(real + 4 + place, number, mask)
    tl.atomic_max(whole + 4 + place, number.to(tl.int64), mask)
    tl.store(before + k, tl.atomic_add(whole + place, 1, mask), mask)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64], ids=str)
def test_atomic_operations(kind, block):
    where = torch.tensor([0, 1, 1, 3, 1, 0, 3, 3, 1, 0, 1] + [0] * 5, dtype=torch.int32)
    value = torch.arange(-5, 11).to(kind)
    real, whole = torch.zeros(8, dtype=kind), torch.zeros(8, dtype=torch.int64)
    real[4:] = -3.0
    before = torch.full((16,), -1)
    launch(_atomics, (16 // block,))(real, whole, before, where, value, 11, BLOCK=block)
    where, value = where[:11].long(), value[:11]
    _same(real[:4], torch.zeros(4, dtype=kind).index_add(0, where, value))
    _same(real[4:], torch.full((4,), -3.0, dtype=kind).scatter_reduce(0, where, value, "amax"))
    assert whole[:4].tolist() == [3, 5, 0, 3]
    _same(whole[4:], torch.zeros(4, dtype=torch.int64).scatter_reduce(0, where, value.long(), "amax"))
    for place in (0, 1, 3):  # the order is that of the programs in one thread
        assert sorted(before[:11][where == place].tolist()) == list(range(int((where == place).sum())))
    assert before[11:].tolist() == [-1] * 5


@triton.jit
def _add_ones(total, whole):
    tl.atomic_add(total, 1.0)
    tl.atomic_add(whole, 1)


def test_threads_add_to_one_number(use_threads):
    use_threads(3)
    total, whole = torch.zeros(1), torch.zeros(1, dtype=torch.int32)
    launch(_add_ones, (30_000,))(total, whole)
    assert int(total) == int(whole) == 30_000


# ---- what there is not


@triton.jit
def _two_axes(x_in, out, BLOCK: tl.constexpr):
    lane = tl.arange(0, BLOCK)
    tl.store(out, tl.sum(lane[None, :] + lane[:, None]))


@triton.jit
def _misfit(x_in, out, BLOCK: tl.constexpr):
    tl.store(out + tl.arange(0, 4), tl.load(x_in + tl.arange(0, BLOCK)))


@triton.jit
def _remainder_of_floats(x_in, out, BLOCK: tl.constexpr):
    tl.store(out, tl.load(x_in) % 2.0)


@triton.jit
def _pointer_times_two(x_in, out, BLOCK: tl.constexpr):
    tl.store(out * 2, 1.0)


@triton.jit
def _text(x_in, out, BLOCK: tl.constexpr):
    tl.store(out, tl.load(x_in) + "two")


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (_two_axes, r"shape \(8, 8\) has two axes; choose smaller blocks on a CPU"),
        (_misfit, r"blocks of the shapes \(\(4,\), \(8,\)\) do not fit"),
        (_remainder_of_floats, "floating point numbers have no `%`"),
        (_pointer_times_two, "a pointer has no `[*]`"),
        (_text, "expected a number, not 'two'"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_cannot_be_computed_is_refused(kernel, message):
    with pytest.raises(TranslationError, match=message):
        launch(kernel, (1,))(torch.zeros(8), torch.zeros(8), BLOCK=8)
