"""exp and log of float32 as instructions on all lanes at once; LLVM calls the C library lane by lane.

Both are Cephes' (S. Moshier, expf.c and logf.c, public domain): reduction of the range, and a polynomial.
"""

from __future__ import annotations

import math
from functools import partial

from gaussian_swaying.kernels.blocks import Block, Emitter

_EXP = (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
_LOG = (
    7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1, -1.6668057665e-1,
    2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
)  # fmt: skip
_LN2 = (0.693359375, -2.12194440e-4)
"""ln 2 in two parts; small integers times the first are exact."""
_ROUNDS = 12582912.0  # 1.5 * 2^23: adding it leaves an integer in the low bits


def exp(emit: Emitter, x: Block) -> Block:
    """e^x within 2 ulp; 0 below -104, infinity above 89, NaN of NaN."""
    add, times = partial(emit.rounded, "+"), partial(emit.rounded, "*")
    x = emit.where(emit.compare(">", x, 89.0), 89.0, emit.where(emit.compare("<", x, -104.0), -104.0, x))
    shifted = add(times(x, math.log2(math.e)), _ROUNDS)
    n = add(shifted, -_ROUNDS)
    r = add(add(x, times(n, -_LN2[0])), times(n, -_LN2[1]))
    value = add(add(times(_polynomial(emit, r, _EXP), times(r, r)), r), 1.0)
    whole = emit.arithmetic("-", emit.bits(shifted, "i32"), 0x4B400000)
    # in two steps, as 2^n alone may be too large or too small for a number
    half = emit.arithmetic(">>", whole, 1)
    for part in (half, emit.arithmetic("-", whole, half)):
        power = emit.arithmetic("<<", emit.arithmetic("+", part, 127), 23)
        value = times(value, emit.bits(power, "f32"))
    return value


def log(emit: Emitter, x: Block) -> Block:
    """The natural logarithm within 2 ulp; -infinity of 0, NaN of negative numbers and of NaN."""
    add, times = partial(emit.rounded, "+"), partial(emit.rounded, "*")
    tiny = emit.compare("<", x, 2.0**-126)
    bits = emit.bits(emit.where(tiny, times(x, 2.0**23), x), "i32")
    # x = 2^n (1 + f) with 1 + f from sqrt(1/2) to sqrt(2)
    above = emit.arithmetic("-", bits, 0x3F3504F3)
    exponent = emit.arithmetic(">>", above, 23)
    mantissa = emit.arithmetic("+", emit.arithmetic("&", above, 0x007FFFFF), 0x3F3504F3)
    f = add(emit.bits(mantissa, "f32"), -1.0)
    n = emit.convert(emit.arithmetic("-", exponent, emit.where(tiny, 23, 0)), "f32")
    square = times(f, f)
    value = add(times(times(_polynomial(emit, f, _LOG), f), square), times(n, _LN2[1]))
    value = add(add(add(value, times(square, -0.5)), f), times(n, _LN2[0]))
    value = emit.where(emit.compare("<", x, math.inf), value, x)  # infinity and NaN
    value = emit.where(emit.compare("==", x, 0.0), -math.inf, value)
    return emit.where(emit.compare("<", x, 0.0), math.nan, value)


def _polynomial(emit: Emitter, x: Block, factors: tuple[float, ...]) -> Block:
    value = emit.constant(factors[0], "f32", x.shape)
    for factor in factors[1:]:
        value = emit.arithmetic("+", emit.arithmetic("*", value, x), factor)
    return value
