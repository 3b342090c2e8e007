import inspect
import re

import pytest
import torch

from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import launch
from gaussian_swaying.kernels.translator import TranslationError, Translator, translate

FACTOR = tl.constexpr(3)
OFFSETS = (10, 20)


# ---- branches


@triton.jit
def _branch(x_in, out):
    k = tl.program_id(0)
    x = tl.load(x_in + k)
    value = 1  # an integer, or a floating point number
    pair = (x, 0)
    place = out + 2 * k
    if x > 0:
        value = x / 2
        pair = (x + 1, 7)
    elif x < -10:
        if x < -20:  # noqa: SIM108
            value = -20
        else:
            value = -10
        place += 1
    tl.store(place, value + pair[0] + pair[1])


def test_a_branch_may_change_the_type_of_a_number():
    x = torch.tensor([4.0, -1.0, -15.0, -25.0, 0.5])
    out = torch.full((5, 2), 77.0)
    launch(_branch, (5,))(x, out)
    expected = [[2 + 5 + 7, 77], [1 - 1, 77], [77, -10 - 15], [77, -20 - 25], [0.25 + 1.5 + 7, 77]]
    assert out.tolist() == expected


@triton.jit
def _ends_early(x_in, out, KEEP: tl.constexpr):
    k = tl.program_id(0)
    x = tl.load(x_in + k)
    if KEEP and x < 0:
        x = -x
        tl.store(out + k, x)
        return
    if x > 10:
        x = 10.0
    else:
        x += 1
        if x > 5:
            if x > 7:
                tl.store(out + k, 8)
                return
            else:
                return
    tl.store(out + k, x + 100)


@pytest.mark.parametrize("keep", [True, False])
def test_a_kernel_may_end_under_a_condition(keep):
    x, out = torch.tensor([-3.0, 1.0, 20.0, 7.0, 6.0, 2.0]), torch.zeros(6)
    launch(_ends_early, (6,))(x, out, KEEP=keep)
    assert out.tolist() == [3.0 if keep else 98.0, 102.0, 110.0, 8.0, 0.0, 103.0]


@triton.jit
def _chosen(x, which: tl.constexpr):
    if which == "twice":
        return 2 * x
    if which is None:
        return x
    return x + (100 if which else 200)


@pytest.mark.parametrize(("which", "expected"), [("twice", [2, 4]), (None, [-1, -2]), (1, [101, 102]), (0, [201, 202])])
def test_a_constant_condition_is_decided(which, expected):
    out = torch.zeros(2)
    if which is None:
        launch(_constant_branch_of_none, (2,))(torch.tensor([1.0, 2.0]), out, WHICH=None)
    else:
        launch(_constant_branch_of_some, (2,))(torch.tensor([1.0, 2.0]), out, WHICH=which)
    assert out.tolist() == expected


@triton.jit
def _constant_branch_of_none(x_in, out, WHICH: tl.constexpr):
    x = tl.load(x_in + tl.program_id(0))
    if WHICH is not None and WHICH.nothing:
        tl.unknown(x)
    if WHICH is None or WHICH.nothing:
        tl.store(out + tl.program_id(0), -_chosen(x, WHICH))


@triton.jit
def _constant_branch_of_some(x_in, out, WHICH: tl.constexpr):
    x = tl.load(x_in + tl.program_id(0))
    if not (WHICH is None):  # noqa: E714
        tl.store(out + tl.program_id(0), _chosen(x, WHICH))
    else:
        tl.unknown(x)


@triton.jit
def _conditional(x_in, out):
    k = tl.program_id(0)
    x = tl.load(x_in + k)
    tl.store(out + k, (x if x > 0 else 5) + (1 if FACTOR == 3 else tl.unknown))


def test_conditional_expressions():
    out = torch.zeros(2)
    launch(_conditional, (2,))(torch.tensor([2.0, -2.0]), out)
    assert out.tolist() == [3, 6]


# ---- loops


@triton.jit
def _loop(out, start, end, step):
    total = 0  # becomes a floating point number
    last = -1
    pair = (0, out)
    for k in range(start, end, step):
        total += k / 2
        last = k
        pair = (pair[0] + 1, pair[1] + 1)
        tl.store(pair[1], k)
    tl.store(out, total)
    tl.store(out + 10, last)
    tl.store(out + 11, pair[0])
    tl.store(pair[1] + 12, -1)


@pytest.mark.parametrize("limits", [(0, 5, 1), (2, 9, 3), (3, 3, 1), (5, 2, 1), (-4, 2, 2)], ids=str)
def test_a_loop_carries_numbers_tuples_and_pointers(limits):
    out, turns = torch.zeros(20), list(range(*limits))
    launch(_loop, (1,))(out, *limits)
    expected = torch.zeros(20)
    expected[1 : 1 + len(turns)] = torch.tensor(turns, dtype=torch.float32)
    expected[0] = sum(turns) / 2
    expected[10] = turns[-1] if turns else -1
    expected[11] = len(turns)
    expected[12 + len(turns)] = -1
    assert torch.equal(out, expected)


@triton.jit
def _blocks_in_a_loop(x_in, out, n, BLOCK: tl.constexpr):
    lane = tl.arange(0, BLOCK)
    total = 0.0
    found = tl.zeros([BLOCK], tl.int32)
    for k in range(0, n, BLOCK):
        total += tl.load(x_in + k + lane, k + lane < n, 0.0)
        found += tl.where(k + lane < n, 1, 0)
    tl.store(out + lane, total)
    tl.store(out + BLOCK + lane, found)


def test_a_number_becomes_a_block_in_a_loop():
    x, out = torch.randn(19), torch.zeros(16)
    launch(_blocks_in_a_loop, (1,))(x, out, 19, BLOCK=8)
    rows = torch.nn.functional.pad(x, (0, 5)).reshape(3, 8)
    assert torch.equal(out[:8], rows[0] + rows[1] + rows[2])
    assert out[8:].tolist() == [3, 3, 3, 2, 2, 2, 2, 2]


@triton.jit
def _halve(x_in, out):
    k = tl.program_id(0)
    x = tl.load(x_in + k)
    steps = 0
    while x > 1.0 and steps < 6:
        x = x / 2
        steps += 1
        for i in range(0, steps):
            if i == 1:
                tl.atomic_add(out + 8 + k, 1)
    tl.store(out + k, x)
    tl.store(out + 4 + k, steps)


def test_a_loop_until_something_is_found():
    out = torch.zeros(12)
    launch(_halve, (4,))(torch.tensor([8.0, 1.0, 0.3, 1000.0]), out)
    assert torch.equal(out[:4], torch.tensor([1.0, 1.0, 0.3, 1000 / 64]))
    assert out[4:8].tolist() == [3, 0, 0, 6]
    assert out[8:].tolist() == [2, 0, 0, 5]


@triton.jit
def _short(out, n, COUNT: tl.constexpr):
    found = ()
    for k in tl.static_range(COUNT):
        found = found + (k * n,)  # noqa: RUF005
    for k in tl.static_range(COUNT):
        tl.store(out + k, found[k])
    for i in range(2):
        tl.store(out + COUNT + i, OFFSETS[i] * n)  # a place in a tuple: the loop is unrolled
    tl.store(out + COUNT + 2, len(found))
    for k in tl.static_range(1, COUNT, 2):
        tl.store(out + COUNT + 2, found[k])


def test_loops_over_constants():
    out = torch.zeros(12)
    launch(_short, (1,))(out, 5, COUNT=9)
    assert out.tolist() == [*range(0, 45, 5), 50, 100, 35]


@triton.jit
def _long(out, COUNT: tl.constexpr):
    for k in range(COUNT):
        tl.store(out + k, k)


def test_long_loops_are_not_unrolled():
    most = Translator.unrolled
    texts = [str(translate(_long, {"COUNT": n}, {"out": "*f32"}, "f32")) for n in (most, most + 1, 1000)]
    assert [text.count("store float") for text in texts] == [most, 1, 1]
    out = torch.zeros(9)
    launch(_long, (1,))(out, COUNT=9)
    assert out.tolist() == list(range(9))


# ---- functions, arguments, programs


@triton.jit
def _pair(x, y=2, SIGN: tl.constexpr = 1):
    total: tl.constexpr = SIGN * 10
    return x + y, total


@triton.jit
def _twice(x):
    return 2 * x


def test_functions_and_arguments():
    out = torch.zeros(7)
    launch(_given, (1,))(out, 0.5, 4.0, 6, TWICE=_twice, NUMBERS=(1, 2))
    assert out.tolist() == [2.5, 10, 4.5, -10, 4.5, 8, 30]
    launch(_given, (1,))(out, 0.5, 4.0, n=6, NUMBERS=(1, 5), TWICE=_pair_sum)
    assert out.tolist() == [2.5, 10, 4.5, -10, 4.5, 6, 33]


@triton.jit
def _pair_sum(x):
    return _pair(x)[0]


@triton.jit
def _given(out, a, b, n, TWICE: tl.constexpr, NUMBERS: tl.constexpr):
    first, sign = _pair(a)
    second, minus = _pair(a, SIGN=-1, y=b)
    third, _ = _pair(a, b)
    tl.store(out, first)
    tl.store(out + 1, sign)
    tl.store(out + 2, second)
    tl.store(out + 3, minus)
    tl.store(out + 4, third)
    tl.store(out + 5, TWICE(b))
    tl.store(out + 6, n * FACTOR + NUMBERS[1] + OFFSETS[0])


@triton.jit
def _large(out, n):
    tl.store(out, n + 1)


@pytest.mark.parametrize("n", [2**31 - 2, 2**31, -(2**40)])
def test_integers_of_any_size_are_passed(n):
    out = torch.zeros(1, dtype=torch.int64)
    launch(_large, (1,))(out, n)
    assert int(out) == n + 1


@triton.jit
def _where_am_i(out):
    x, y, z = tl.program_id(0), tl.program_id(1), tl.program_id(2)
    nx, ny = tl.num_programs(0), tl.num_programs(1)
    tl.store(out + (z * ny + y) * nx + x, 100 * z + 10 * y + x)
    tl.store(out + nx * ny * tl.num_programs(2), nx + ny)


@pytest.mark.parametrize("grid", [(3,), (3, 2), (2, 3, 4)])
def test_programs_of_a_grid(grid):
    shape = (*grid, 1, 1)[:3]
    out = torch.full((shape[0] * shape[1] * shape[2] + 1,), -1, dtype=torch.int32)
    launch(_where_am_i, grid)(out)
    x, y, z = (torch.arange(n) for n in shape)
    expected = 100 * z[:, None, None] + 10 * y[:, None] + x
    assert out.tolist() == [*expected.reshape(-1).tolist(), shape[0] + shape[1]]


# ---- what cannot be translated


@triton.jit
def _inner(x):
    y = x + 1
    return tl.unknown(y)


@triton.jit
def _through(out):
    x = tl.load(out)
    tl.store(out, _inner(x))


@triton.jit
def _unknown_name(out):
    tl.store(out, nowhere)  # noqa: F821


@triton.jit
def _unknown_operation(out):
    tl.store(out, tl.load(out) @ 2)


@triton.jit
def _returns_under_a_condition(out):
    if tl.load(out) > 0:
        return 1
    tl.store(out, 1.0)


@triton.jit
def _returns_within_a_loop(out):
    for _k in range(tl.load(out).to(tl.int32)):
        if tl.load(out) > 1:
            return


@triton.jit
def _returns_from_a_loop(out):
    for _k in range(tl.load(out).to(tl.int32)):
        return


@triton.jit
def _condition_of_lanes(out):
    if tl.arange(0, 4) > 2:
        tl.store(out, 1.0)


@triton.jit
def _unpacks(out):
    a, b = tl.load(out)
    tl.store(out, a + b)


@triton.jit
def _two_buffers(out):
    place = out
    if tl.load(out) > 0:
        place = "nothing"
    tl.store(place, 1.0)


@triton.jit
def _not_constant(out):
    tl.store(out, _pair(1.0, 2.0, tl.load(out))[0])


@triton.jit
def _missing(out):
    tl.store(out, _pair()[0])


@triton.jit
def _twice_given(out):
    tl.store(out, _pair(1.0, x=2.0)[0])


@triton.jit
def _unknown_type(out):
    tl.store(out, tl.load(out).to(tl.float8))


@triton.jit
def _place_in_a_tuple(out):
    tl.store(out, OFFSETS[tl.load(out).to(tl.int32)])


@triton.jit
def _of_python(out):
    tl.store(out, sorted(OFFSETS)[0])


@triton.jit
def _attribute(out):
    tl.store(out, tl.load(out).T)


@triton.jit
def _between(out):
    tl.store(out, 0 < tl.load(out) < 1)


@triton.jit
def _with(out):
    with out:
        tl.store(out, 1.0)


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (_unknown_name, "`nowhere` is not known here"),
        (_unknown_operation, "no operation MatMult"),
        (_returns_under_a_condition, "cannot return under a condition that is not constant"),
        (_returns_within_a_loop, "cannot return under a condition that is not constant"),
        (_returns_from_a_loop, "cannot return from a loop"),
        (_condition_of_lanes, "a condition must be one number"),
        (_unpacks, "cannot unpack .* into 2 names"),
        (_two_buffers, "on one way and .*'nothing' on another|'nothing' on one way"),
        (_not_constant, "SIGN of _pair is no constant"),
        (_missing, "_pair needs the argument x"),
        (_twice_given, "_pair has no argument x, or it is given twice"),
        (_unknown_type, "no type float8"),
        (_place_in_a_tuple, "the place in a tuple must be constant"),
        (_of_python, "`sorted` is not known here"),
        (_attribute, "a block has no `T`"),
        (_between, "cannot translate `0 < tl.load"),
        (_with, "cannot translate `with out:"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_an_error_names_function_and_line(kernel, message):
    start = inspect.getsourcelines(kernel.fn)[1] + 2
    with pytest.raises(TranslationError, match=message) as error:
        launch(kernel, (1,))(torch.zeros(4))
    name, near = re.match(r"(\S+), near line (\d+): ", str(error.value)).groups()
    assert name == f"{__name__}.{kernel.fn.__name__}"
    assert start <= int(near) <= start + 2


def test_an_error_names_the_innermost_function():
    _, first = inspect.getsourcelines(_inner.fn)
    with pytest.raises(TranslationError, match=r"`tl.unknown` is not translated") as error:
        launch(_through, (1,))(torch.zeros(4))
    assert f"{__name__}._inner, near line {first + 3}: " in str(error.value)
    assert str(error.value).count("near line") == 1


@triton.jit
def _after_a_call(out):
    x = tl.load(out)
    tl.store(out, _pair(x)[0] @ 2)


def test_an_error_after_a_call_is_in_the_line_of_the_call():
    _, first = inspect.getsourcelines(_after_a_call.fn)
    with pytest.raises(TranslationError, match=f"_after_a_call, near line {first + 3}: no operation"):
        launch(_after_a_call, (1,))(torch.zeros(4))
