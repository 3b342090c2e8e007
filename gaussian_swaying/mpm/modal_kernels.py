"""Formulas of a substep of ``modes``, and kernels of it for one scene in a browser."""

from gaussian_swaying.geometry.linalg_triton import add3, axpy3, cross3, dot3, load3, store3
from gaussian_swaying.kernels.language import tl, triton

ROUNDS = tl.constexpr(32)  # most rounds of the equations for the drag
LEFT = tl.constexpr(1e-10)  # square of what they may leave, as a share
TALL = tl.constexpr(4)  # rows of the drag that are summed together


@triton.jit
def oscillation(square, alpha, dt):
    r"""Decay :math:`e^{-\alpha t}`, :math:`\sin(\omega_d t) / \omega_d` and :math:`\cos(\omega_d t)` of a damped mode.

    A mode that is damped more than critically has hyperbolic functions.
    """
    apart = square - alpha * alpha
    rate = tl.sqrt(tl.maximum(tl.abs(apart), 1e-12))
    over = apart < 0
    angle = tl.minimum(rate * dt, 300.0)
    up = tl.exp(tl.where(over, angle, 0.0))
    sine = tl.where(over, 0.5 * (up - 1 / up), tl.sin(angle)) / rate
    cosine = tl.where(over, 0.5 * (up + 1 / up), tl.cos(angle))
    return tl.exp(-alpha * dt), sine, cosine


@triton.jit
def factors(square, alpha, dt):
    """Coefficients of a substep for amplitude, rate and load, see :func:`amplitude`."""
    decay, sine, cosine = oscillation(square, alpha, dt)
    return decay * (cosine + alpha * sine), decay * sine, decay * (cosine - alpha * sine)


@triton.jit
def amplitude(q, p, rest, keep, sine):
    """The amplitude after a substep, about that at ``rest`` under the load."""
    return rest + keep * (q - rest) + sine * p


@triton.jit
def warp(turn, shift):
    r"""A displacement rotated progressively: :math:`\int_0^1 R(s w)\, ds\; d`, as ``modes.warped``."""
    square = dot3(turn, turn)
    small = square < 1e-2
    safe = tl.where(small, 1.0, square)
    angle = tl.sqrt(safe)
    half = tl.sin(0.5 * angle)
    cosine = tl.where(small, 0.5 - square / 24 + square * square / 720, 2 * half * half / safe)
    cubic = tl.where(small, 1 / 6 - square / 120 + square * square / 5040, (1 - tl.sin(angle) / angle) / safe)
    first = cross3(turn, shift)
    return add3(shift, 1.0, axpy3(cosine, first, cubic, cross3(turn, first)))


@triton.jit(do_not_specialize=("count",))
def modal_factors(square, ratio, numbers, out, count, BLOCK: tl.constexpr):
    """:func:`factors` of modes, and their squares; ``numbers``: substep, stiffness and the solver's two dampings."""
    m = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = m < count
    own = tl.load(numbers + 1) * tl.load(square + m, mask, 1.0)
    alpha = tl.load(ratio + m, mask, 0.0) * tl.sqrt(own) + 0.5 * (tl.load(numbers + 2) + tl.load(numbers + 3) * own)
    store3(out, count, m, factors(own, alpha, tl.load(numbers)), mask)
    tl.store(out + 3 * count + m, own, mask)


@triton.jit(do_not_specialize=("count",))
def modal_moved(shapes, q, p, ahead, out, count, BLOCK: tl.constexpr):
    """For each row of ``shapes``, the displacement at ``ahead`` seconds from now, and the velocity."""
    row = tl.program_id(0)
    time = tl.load(ahead)
    at = tl.zeros([BLOCK], tl.float32)
    rate = tl.zeros([BLOCK], tl.float32)
    for start in range(0, count, BLOCK):
        m = start + tl.arange(0, BLOCK)
        mask = m < count
        shape = tl.load(shapes + row * count + m, mask, 0.0)
        speed = tl.load(p + m, mask, 0.0)
        at += shape * (tl.load(q + m, mask, 0.0) + time * speed)
        rate += shape * speed
    tl.store(out + 2 * row, tl.sum(at))
    tl.store(out + 2 * row + 1, tl.sum(rate))


@triton.jit(do_not_specialize=("count", "sites"))
def modal_load(shapes, forces, load, sites, count, BLOCK: tl.constexpr):
    """The load on modes by the first three of eight numbers of each site."""
    m = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = m < count
    found = tl.zeros([BLOCK], tl.float32)
    for s in range(0, sites):
        for c in tl.static_range(3):
            found += tl.load(forces + 8 * s + c) * tl.load(shapes + (3 * s + c) * count + m, mask, 0.0)
    tl.store(load + m, found, mask)


@triton.jit(do_not_specialize=("count", "sites"))
def modal_drag(shapes, forces, drag, sites, count, BLOCK: tl.constexpr):
    """Half of the drag of the modes, by the seventh of eight numbers of each site; TALL rows along the second axis."""
    first = tl.program_id(1) * TALL
    m = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = m < count
    zero = tl.zeros([BLOCK], tl.float32)
    a, b, c, d = zero, zero, zero, zero
    for s in range(0, sites):
        half = 0.5 * tl.load(forces + 8 * s + 6)
        for k in tl.static_range(3):
            row = shapes + (3 * s + k) * count
            whole = half * tl.load(row + m, mask, 0.0)
            a += tl.load(row + first) * whole
            b += tl.load(row + first + 1, first + 1 < count, 0.0) * whole
            c += tl.load(row + first + 2, first + 2 < count, 0.0) * whole
            d += tl.load(row + first + 3, first + 3 < count, 0.0) * whole
    found = (a, b, c, d)
    for k in tl.static_range(TALL):
        tl.store(drag + (first + k) * count + m, found[k], mask & (first + k < count))


@triton.jit(do_not_specialize=("count",))
def modal_swing(q, p, load, drag, factor, left, lost, count, BLOCK: tl.constexpr):
    """Amplitudes and rates after a substep with drag at the mean rate, solved by minimal residuals."""
    whole = 0.0
    for start in range(0, count, BLOCK):
        m = start + tl.arange(0, BLOCK)
        mask = m < count
        sine = tl.load(factor + count + m, mask, 0.0)
        pull = tl.load(load + m, mask, 0.0) - tl.load(factor + 3 * count + m, mask, 0.0) * tl.load(q + m, mask, 0.0)
        speed = tl.load(p + m, mask, 0.0)
        change = (tl.load(factor + 2 * count + m, mask, 1.0) - 1) * speed + sine * pull
        tl.store(left + m, change, mask)
        whole += tl.sum(change * change)
    rest = whole
    k = 0
    while (k < ROUNDS) & (rest > LEFT * whole):
        for i in range(0, count):
            total = tl.zeros([BLOCK], tl.float32)
            for start in range(0, count, BLOCK):
                m = start + tl.arange(0, BLOCK)
                mask = m < count
                total += tl.load(drag + i * count + m, mask, 0.0) * tl.load(left + m, mask, 0.0)
            tl.store(lost + i, tl.sum(total))
        along = 0.0
        size = 0.0
        for start in range(0, count, BLOCK):
            m = start + tl.arange(0, BLOCK)
            mask = m < count
            own = tl.load(left + m, mask, 0.0)
            image = own + tl.load(factor + count + m, mask, 0.0) * tl.load(lost + m, mask, 0.0)
            along += tl.sum(own * image)
            size += tl.sum(image * image)
        share = along / size
        rest = 0.0
        for start in range(0, count, BLOCK):
            m = start + tl.arange(0, BLOCK)
            mask = m < count
            own = tl.load(left + m, mask, 0.0)
            gone = tl.load(lost + m, mask, 0.0)
            tl.store(load + m, tl.load(load + m, mask, 0.0) - share * gone, mask)
            own -= share * (own + tl.load(factor + count + m, mask, 0.0) * gone)
            tl.store(left + m, own, mask)
            rest += tl.sum(own * own)
        k += 1
    for start in range(0, count, BLOCK):
        m = start + tl.arange(0, BLOCK)
        mask = m < count
        was = tl.load(q + m, mask, 0.0)
        speed = tl.load(p + m, mask, 0.0)
        keep, sine, own = load3(factor, count, m, mask)
        square = tl.load(factor + 3 * count + m, mask, 1.0)
        pull = tl.load(load + m, mask, 0.0)
        tl.store(q + m, amplitude(was, speed, pull / square, keep, sine), mask)
        tl.store(p + m, own * speed + sine * (pull - square * was), mask)


@triton.jit(do_not_specialize=("sites",))
def modal_placed(moved, rest, out, sites, BLOCK: tl.constexpr):
    """Positions of the sites: rest positions plus the displacement of :func:`modal_shown`."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = n < sites
    found = warp(load3(moved, 2, 6 * (sites + n), mask), load3(moved, 2, 6 * n, mask))
    store3(out, 1, 3 * n, add3(load3(rest, 1, 3 * n, mask), 1.0, found), mask)


@triton.jit(do_not_specialize=("nodes",))
def modal_shown(moved, out, nodes, BLOCK: tl.constexpr):
    """Displacements of nodes, four numbers each, by products with their shapes and turns."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = n < nodes
    found = warp(load3(moved, 2, 6 * (nodes + n), mask), load3(moved, 2, 6 * n, mask))
    store3(out, 1, 4 * n, found, mask)
