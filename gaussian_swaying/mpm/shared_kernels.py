"""Functions shared by the kernels of the formulations: weights, loads and stores, forces and their work.

The references are :mod:`~gaussian_swaying.mpm.transfer`, :mod:`~gaussian_swaying.mpm.timestep` and the torch substeps
of :mod:`~gaussian_swaying.mpm.formulation`; the kernels follow them and are tested against them. Loops over i and j
stay loops in Triton's intermediate code: if they are unrolled, its passes take minutes.
"""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    cross3,
    dot3,
    largest,
    largest_eigenvalue,
    load3,
    load9,
    matmul,
    matvec,
    read,
    rotation,
    store3,
    transpose,
)
from gaussian_swaying.kernels.language import tl, triton

SCHEDULE = 4
"""Columns of the schedule, a row per substep: how long forces act [s], the substep [s], the decay of velocities.

Row 0 has a last column: how long forces act in the last substep.
"""

# Numbers that differ between bodies and between grids, and are not specialised. Otherwise Triton would compile a kernel
# again whenever one of them becomes one or a multiple of 16, in the middle of a run, even while a graph is recorded.
VARIES = (
    "count", "cells", "pieces", "nodes", "rows", "scenes", "scene_size", "step_offset", "sx", "sy", "ox", "oy", "oz",
    "nx", "ny", "nz", "all_rows", "active_count", "shares", "bent", "room", "scene_nodes", "slots",
)  # fmt: skip


@triton.jit
def node_weight(f, i, inverse_dx):
    """Quadratic B-spline weight of node i of one axis and its slope; f in [0.5, 1.5)."""
    t = f - (1.5 - 0.5 * i)
    a = tl.where(i == 1, -1.0, 0.5) * t
    return a * t + tl.where(i == 1, 0.75, 0.0), 2 * inverse_dx * a


@triton.jit
def vector(place, mask):
    """Three numbers in a row."""
    return tl.load(place, mask, 0.0), tl.load(place + 1, mask, 0.0), tl.load(place + 2, mask, 0.0)


@triton.jit
def sums(x, AXIS: tl.constexpr):
    """Sums over an axis for a vector."""
    return (tl.sum(x[0], AXIS), tl.sum(x[1], AXIS), tl.sum(x[2], AXIS))


@triton.jit
def load_four(place):
    """Four numbers in a row, of which the first is at a multiple of 16 bytes, by one instruction of an NVIDIA GPU."""
    return tl.inline_asm_elementwise(
        "ld.global.v4.f32 {$0, $1, $2, $3}, [$4];",
        "=f,=f,=f,=f,l",
        [place.to(tl.int64)],
        dtype=(tl.float32, tl.float32, tl.float32, tl.float32),
        is_pure=False,
        pack=1,
    )


@triton.jit
def add_four(place, values, mask):
    """Add four numbers to those in a row, as atomically as one each, by one instruction of an NVIDIA GPU from 9.0 on.

    The first is at a multiple of 16 bytes. Each thread must have one element, or elements are added several times.
    """
    tl.inline_asm_elementwise(
        """{
            .reg .pred masked;
            setp.ne.s32 masked, $6, 0;
            @masked red.relaxed.gpu.global.add.v4.f32 [$1], {$2, $3, $4, $5};
            mov.u32 $0, 0;
        }""",
        "=r,l,f,f,f,f,r",
        [place.to(tl.int64), values[0], values[1], values[2], values[3], mask.to(tl.int32)],
        dtype=tl.int32,
        is_pure=False,
        pack=1,
    )


@triton.jit
def axis_weights(f, inverse_dx):
    """The three weights of one axis and their slopes."""
    w0, g0 = node_weight(f, 0, inverse_dx)
    w1, g1 = node_weight(f, 1, inverse_dx)
    w2, g2 = node_weight(f, 2, inverse_dx)
    return (w0, w1, w2), (g0, g1, g2)


@triton.jit
def _columns(values, count, index, mask, FIRST: tl.constexpr, COUNT: tl.constexpr):
    found = ()
    for k in tl.static_range(COUNT):
        found = found + (tl.load(values + (FIRST + k) * count + index, mask, 0.0),)
    return found


@triton.jit
def numbers_of_force(
    k: tl.constexpr, FORCES: tl.constexpr, index, mask, scene, values, count, vectors, scenes, step, numbers
):  # fmt: skip
    """The parameters of force k: per point, shared, and per substep."""
    point = _columns(values, count, index, mask, FORCES.per_point[k][0], FORCES.per_point[k][1])
    row = vectors + (step * scenes + scene) * FORCES.width
    own = read(numbers, FORCES.numbers[k][0], FORCES.numbers[k][1])
    return point, own, read(row, FORCES.per_substep[k][0], FORCES.per_substep[k][1])


@triton.jit
def _force(
    k: tl.constexpr, FORCES: tl.constexpr, F, velocity, position, index, mask, scene, values, count, vectors, scenes,
    step, numbers
):  # fmt: skip
    """Force k on some particles [N] and its resistance [kg/s]."""
    OPTIONS: tl.constexpr = FORCES.options[k]  # Triton 3.6 passes a tuple of numbers only as a named constant
    point, own, now = numbers_of_force(k, FORCES, index, mask, scene, values, count, vectors, scenes, step, numbers)
    return FORCES.functions[k](F, velocity, position, point, own, now, numbers + FORCES.tables[k], OPTIONS)


@triton.jit
def sum_of_forces(
    FORCES: tl.constexpr, F, velocity, position, index, mask, scene, values, count, vectors, scenes, step, numbers
):  # fmt: skip
    """Sum of the forces of kernels on some particles [N] and of their resistances [kg/s]; FORCES: ``Composed``."""
    for k in tl.static_range(len(FORCES.functions)):
        more, drag = _force(
            k, FORCES, F, velocity, position, index, mask, scene, values, count, vectors, scenes, step, numbers
        )
        if k == 0:
            force = more
            resistance = drag
        else:
            force = add3(force, 1.0, more)
            resistance += drag
    return force, resistance


@triton.jit
def add_given(force, resistance, force_in, where, mask):
    """Add the given force and resistance, rows of ``force_in``."""
    more = load3(force_in, 1, where * 4, mask)
    resistance += tl.load(force_in + where * 4 + 3, mask, 0.0)
    return add3(force, 1.0, more), resistance


@triton.jit
def account(force, resistance, velocity, kick, before, IMPLICIT: tl.constexpr, load, count, index, mask):
    """Accumulate the work of external forces: the part that ends with this velocity; store the next part's start.

    ``load`` has the rows work, force (with implicit drag force + D v, D and v, eight rows in all).
    """
    work = tl.load(load + index, mask, 0.0)
    last = load3(load + count, count, index, mask)
    if IMPLICIT:
        held = tl.load(load + 4 * count + index, mask, 0.0)
        was = load3(load + 5 * count, count, index, mask)
        for k in tl.static_range(3):
            work += 0.5 * before * (last[k] - held * velocity[k]) * (was[k] + velocity[k])
            tl.store(load + (1 + k) * count + index, force[k] + resistance * velocity[k], mask)
            tl.store(load + (5 + k) * count + index, velocity[k], mask)
        tl.store(load + 4 * count + index, resistance, mask)
    else:
        for k in tl.static_range(3):
            work += 0.5 * velocity[k] * (before * last[k] + kick * force[k])
            tl.store(load + (1 + k) * count + index, force[k], mask)
    tl.store(load + index, work, mask)


@triton.jit
def squared_stretch(F, mu, lam):
    """Square of the largest stretch, at least 1; arguments as a law's wave."""
    return largest(largest_eigenvalue(matmul(transpose(F), F)), 1.0)


@triton.jit
def wave_speed(F, density, mu, lam, WAVE: tl.constexpr, SPATIAL: tl.constexpr):
    """Speed of a wave [m/s], as ``timestep.wave_speed``."""
    squared = WAVE(F, mu, lam) / density
    if SPATIAL:
        squared = squared * squared_stretch(F, mu, lam)
    return tl.sqrt(squared)


@triton.jit
def keep_largest(out, speed, mask):
    """Atomic maximum into ``out``; NaN becomes infinity, which the maximum would drop."""
    speed = tl.where(mask, tl.where(speed == speed, speed, float("inf")), 0.0)
    tl.atomic_max(out, tl.max(speed), sem="relaxed")


@triton.jit(do_not_specialize=VARIES)
def elastic_energy(F_in, mu_in, lam_in, out, count, ENERGY: tl.constexpr, BLOCK: tl.constexpr):
    """Energy density of particles [J/m³], as ``ConstitutiveLaw.energy``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = load9(F_in, 1, index * 9, mask)
    mu = tl.load(mu_in + index, mask, 0.0)
    lam = tl.load(lam_in + index, mask, 0.0)
    tl.store(out + index, ENERGY(F, mu, lam), mask)


@triton.jit(do_not_specialize=VARIES)
def largest_speed(
    F_in, density, mu_in, lam_in, velocity, out, count, WAVE: tl.constexpr, SPATIAL: tl.constexpr, BLOCK: tl.constexpr
):
    """Largest speed of a wave [m/s] (and of its particle, SPATIAL), into ``out``."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    F = load9(F_in, 1, index * 9, mask)
    mu = tl.load(mu_in + index, mask, 0.0)
    lam = tl.load(lam_in + index, mask, 0.0)
    speed = wave_speed(F, tl.load(density + index, mask, 1.0), mu, lam, WAVE, SPATIAL)
    if SPATIAL:
        v = load3(velocity, 1, index * 3, mask)
        speed += tl.sqrt(dot3(v, v))
    keep_largest(out, speed, mask)


@triton.jit(do_not_specialize=VARIES)
def site_forces(
    moved, rest, values, vectors, numbers, out, count, scene_size, scenes, step_offset, FORCES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Forces on sites that turn without strain, as ``Modes._site_state`` places them.

    ``moved`` has two columns, for amplitudes and their rates, and in each scene the displacements and then the turns of
    its sites. ``out`` gets a row of eight for each: the force in the axes of the site, that in space, its resistance.
    """
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    scene = index // scene_size
    row = 6 * (index - scene * scene_size) + 12 * scene_size * scene
    shift = load3(moved, 2, row, mask)
    speed = load3(moved, 2, row + 1, mask)
    turn = load3(moved, 2, row + 6 * scene_size, mask)
    R = rotation(turn)
    bend = cross3(turn, shift)
    start = load3(rest, 1, 3 * index, mask)
    place = add3(start, 1.0, axpy3(0.5, bend, 1.0, shift))
    force, resistance = sum_of_forces(
        FORCES, R, matvec(R, speed), place, index, mask, scene, values, count, vectors, scenes, step_offset, numbers
    )
    store3(out, 1, 8 * index, matvec(transpose(R), force), mask)
    store3(out, 1, 8 * index + 3, force, mask)
    tl.store(out + 8 * index + 6, resistance, mask)
