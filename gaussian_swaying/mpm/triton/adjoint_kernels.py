"""Kernels of the backward pass of the ``total`` substep; the reference is torch's autograd of the torch substep.

The adjoint of a substep has the structure of the substep: the gradient by the nodal forces is gathered at the
particles, multiplied there by the derivatives of stress and force, and scattered to the nodes. So these kernels follow
those in ``total_kernels``, with the same order of particles and without atomics.

Substeps are numbered within a segment. A backward pass counts forward, from ``last`` down: its ``first_step`` is the
number of substeps that it has done. Rows of ``bars``, one per active node: gradient by displacement and by velocity,
each in four columns of eight. Rows of ``history``: displacement and velocity at the start of each substep, likewise.
"""

from gaussian_swaying.geometry.linalg_triton import add3, axpy9, dot3, load3, scale3, scale9, store3
from gaussian_swaying.kernels.derive import vjp
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.damping import kelvin_voigt
from gaussian_swaying.mpm.dispatch import pk1, pk1_adjoint
from gaussian_swaying.mpm.sheets import flattened, flattened_adjoint, sheet_stress_adjoint, without_normal
from gaussian_swaying.mpm.triton.shared import VARIES, axis_weights, node_weight, numbers_of_force, sums, vector
from gaussian_swaying.mpm.triton.total_kernels import cells_of, gather, law_row, load_particles, motion

kelvin_voigt_adjoint = vjp(kelvin_voigt, {"F": 9, "rate": 9, "mu": 0, "lam": 0, "time": 0}, ("F", "rate", "mu", "lam"))


@triton.jit(do_not_specialize=VARIES)
def keep_nodes(active, nodes, fields, history, first_step, step_offset, BLOCK: tl.constexpr):
    """Keep displacement and velocity of the active nodes at the start of a substep."""
    step = tl.load(first_step) + step_offset
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    k = place // 8
    mask = k < nodes
    node = tl.load(active + k, mask, 0)
    value = tl.load(fields + node * 8 + place % 8, mask, 0.0)
    tl.store(history + step.to(tl.int64) * nodes * 8 + place, value, mask)


@triton.jit(do_not_specialize=VARIES)
def keep_rows(residual, rows, history, first_step, step_offset, BLOCK: tl.constexpr):
    """Store the velocities that held points had in the previous substep, before they were stopped."""
    step = tl.load(first_step) + step_offset
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = place < 4 * rows
    tl.store(history + step * rows * 4 + place, tl.load(residual + place, mask, 0.0), mask)


@triton.jit
def _add(to, value, real, chunk):
    """Write the sums of some cells; from the second chunk of particles on, add to what is there."""
    if chunk > 0:
        value += tl.load(to, real, 0.0)
    tl.store(to, value, real)


@triton.jit(do_not_specialize=VARIES)
def particles_adjoint(
    fraction, material, normals, law, law_table, values, count,
    cell_start, cell_node, cell_scene, cells, cell_nodes,
    fields, force_bar, partial, found, shares,
    vectors, scenes, numbers, first_step, step_offset, last,
    sx, sy, inverse_dx, viscous_time,
    LAWS: tl.constexpr, MULTI: tl.constexpr, FORCES: tl.constexpr, VISCOUS: tl.constexpr, MATERIAL: tl.constexpr,
    SHARES: tl.constexpr, WIDTH: tl.constexpr, CELLS: tl.constexpr, LANES: tl.constexpr,
    VIRTUAL: tl.constexpr, SHEETS: tl.constexpr,
):  # fmt: skip
    """Gradients by the nodal displacements (columns 0 to 2 of ``partial``) and velocities (4 to 6), summed by cells.

    With MATERIAL the gradients by mu, lambda and volume are added to the three rows of ``found``; with SHARES those by
    the numbers of the substep and of the force, of which there is at most one, are written to a row of eight for each
    substep and cell.
    """
    LOADED: tl.constexpr = len(FORCES.functions) > 0
    step = tl.load(last) - tl.load(first_step) - step_offset
    cell, real, start, end, node, scene, longest = cells_of(cell_start, cell_node, cell_scene, cells, CELLS)
    lane = tl.arange(0, LANES)[None, :]
    known = real[:, None]
    for chunk in range(0, longest, LANES):
        index = start[:, None] + chunk + lane
        mask = index < end[:, None]
        f, volume, mu, lam = load_particles(fraction, material, count, index, mask)
        wz, gz = axis_weights(f[2], inverse_dx)
        if VIRTUAL:
            place = tl.minimum(cell, cells - 1)[:, None]
        else:
            place = node
        _u, F, v, rate = motion(
            fields, place, sx, sy, f, wz, gz, inverse_dx, known, VISCOUS, LOADED, cell_nodes, cells, VIRTUAL
        )
        a, Q, _v = gather(force_bar, place, sx, sy, f, wz, gz, inverse_dx, known, False, cell_nodes, cells, VIRTUAL)
        row = law_row(law, law_table, index, mask, MULTI)
        if SHEETS:
            bent = F
            n = load3(normals, count, index, mask)
            F, m, area, thickness, thinning = flattened(bent, n, mu, lam)
            P = pk1(F, mu, lam, row, LAWS)
            by_bent, more_mu, by_P, by_shape, by_m, by_area, by_thickness, by_thinning = sheet_stress_adjoint(
                bent, n, mu, P, F, m, area, thickness, thinning, Q
            )
            by_F, by_mu, by_lam = pk1_adjoint(F, by_P, mu, lam, row, LAWS)
            by_F = axpy9(1.0, by_F, 1.0, by_shape)
            by_mu += more_mu
            rate = without_normal(rate, n)
            Q = without_normal(Q, n)
        else:
            by_F, by_mu, by_lam = pk1_adjoint(F, Q, mu, lam, row, LAWS)
        if VISCOUS:
            more, by_rate, one, two = kelvin_voigt_adjoint(F, rate, mu, lam, viscous_time, Q)
            by_F = axpy9(1.0, by_F, 1.0, more)
            by_mu += one
            by_lam += two
            if SHEETS:
                by_rate = without_normal(by_rate, n)
            by_rate = scale9(-volume, by_rate)
        by_F = scale9(-volume, by_F)
        by_mu *= -volume
        by_lam *= -volume
        if LOADED:
            point, own, now = numbers_of_force(
                0, FORCES, index, mask, scene, values, count, vectors, scenes, step, numbers
            )
            more, by_v, by_vector, by_numbers = FORCES.adjoints[0](F, v, point, own, now, numbers + FORCES.tables[0], a)
            by_F = axpy9(1.0, by_F, 1.0, more)
            if SHARES:
                to = shares + (step.to(tl.int64) * cells + cell) * 8
                for c in tl.static_range(3):
                    _add(to + c, tl.sum(tl.where(mask, by_vector[c], 0.0), 1), real, chunk)
                    _add(to + 4 + c, tl.sum(tl.where(mask, by_numbers[c], 0.0), 1), real, chunk)
        if SHEETS:
            bars = scale3(-volume, by_m) + (-volume * by_area, -volume * by_thickness, -volume * by_thinning)
            by_F, one, two = flattened_adjoint(bent, n, mu, lam, by_F + bars)
            by_F = axpy9(1.0, by_F, -volume, by_bent)
            by_mu += one
            by_lam += two
        if MATERIAL:
            to = found + index
            tl.store(to, tl.load(to, mask, 0.0) + by_mu, mask)
            tl.store(to + count, tl.load(to + count, mask, 0.0) + by_lam, mask)
            # the stress is homogeneous in mu and lambda, so Q : P follows from its derivatives
            to = found + 2 * count + index
            work = (mu * by_mu + lam * by_lam) / tl.where(mask, volume, 1.0)
            tl.store(to, tl.load(to, mask, 0.0) + work, mask)
        for i in range(3):
            wx, gx = node_weight(f[0], i, inverse_dx)
            for j in range(3):
                wy, gy = node_weight(f[1], j, inverse_dx)
                w = wx * wy
                ax = gx * wy
                ay = wx * gy
                a = _across(by_F, ax, ay)
                if VISCOUS:
                    b = _across(by_rate, ax, ay)
                    if LOADED:
                        b = add3(b, w, by_v)
                for k in tl.static_range(3):
                    out = partial + (((i * 3 + j) * 3 + k) * (cells + 1) + cell) * WIDTH
                    gw = gz[k] * w
                    for c in tl.static_range(3):
                        _add(out + c, tl.sum(wz[k] * a[c] + gw * by_F[3 * c + 2], 1), real, chunk)
                        if VISCOUS:
                            _add(out + 4 + c, tl.sum(wz[k] * b[c] + gw * by_rate[3 * c + 2], 1), real, chunk)
                        elif LOADED:
                            _add(out + 4 + c, tl.sum(wz[k] * w * by_v[c], 1), real, chunk)


@triton.jit
def bend_adjoint(bent_node, fields, force_bar, found):
    """Add the gradient by a row of the matrix of a cell that bends, 32 columns of which 27 count, in a substep."""
    row = tl.program_id(0) * 27 + tl.program_id(1)
    o = tl.arange(0, 32)
    a = vector(force_bar + tl.load(bent_node + row) * 8, True)
    u = vector(fields + tl.load(bent_node + tl.program_id(0) * 27 + o, o < 27, 0) * 8, o < 27)
    to = found + row * 32 + o
    tl.store(to, tl.load(to) - (a[0] * u[0] + a[1] * u[1] + a[2] * u[2]))


@triton.jit
def _across(m, x, y):
    """The first two columns of a matrix times two numbers."""
    return (m[0] * x + m[1] * y, m[3] * x + m[4] * y, m[6] * x + m[7] * y)


@triton.jit(do_not_specialize=VARIES)
def nodes_adjoint(
    active, source, sources, inverse_mass, rates, held, nodes, partial, fields, force_bar, history, bars, mass_bar,
    schedule, first_step, step_offset, last, gravity_x, gravity_y, gravity_z,
    SUM: tl.constexpr, PUSH: tl.constexpr, FINISH: tl.constexpr, VELOCITY: tl.constexpr, HELD: tl.constexpr,
    MASS: tl.constexpr, DAMPED: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, SOURCES: tl.constexpr,
):  # fmt: skip
    """Gradients by the nodal fields, and by the forces of the substep before.

    SUM adds the sums of the particles of the later substep, whose part for the velocity exists with VELOCITY. PUSH goes
    back through the new displacement, which ends a substep. FINISH goes back through pins (HELD), damping and the new
    velocity, and puts the state at the start of the substep into ``fields``, for the particles. MASS adds the gradient
    by the inverse mass to ``mass_bar``.
    """
    step = tl.load(last) - tl.load(first_step) - step_offset
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    own = bars + k * 8
    u, v = vector(own, mask), vector(own + 4, mask)
    if SUM:
        o = tl.arange(0, SOURCES)[:, None]  # all at once
        known = mask[None, :] & (o < sources)
        row = partial + tl.load(source + o * nodes + k[None, :], known, 0) * WIDTH
        u = add3(u, 1.0, sums(vector(row, known), 0))
        if VELOCITY:
            v = add3(v, 1.0, sums(vector(row + 4, known), 0))
        store3(own, 1, 0, u, mask)
    if PUSH:
        v = add3(v, tl.load(schedule + (step + 1) * 4 + 1), u)
    if FINISH:
        kick = tl.load(schedule + (step + 1) * 4)
        decay = tl.load(schedule + (step + 1) * 4 + 2)
        if DAMPED:
            decay *= tl.exp(-kick * tl.load(rates + k, mask, 0.0))
        inverse = tl.load(inverse_mass + k, mask, 0.0)
        node = tl.load(active + k, mask, 0)
        before = history + (step.to(tl.int64) * nodes + k) * 8
        w = vector(before + 4, mask)
        store3(fields + node * 8, 1, 0, vector(before, mask), mask)
        store3(fields + node * 8 + 4, 1, 0, w, mask)
        if MASS:
            # what forces and held points added to the velocity is proportional to the inverse mass
            after = before + nodes.to(tl.int64) * 8
            rest = decay
            if HELD:
                rest = tl.where(tl.load(held + k, mask, 0) == 0, decay, 0.0)
            free = add3(w, kick, (gravity_x, gravity_y, gravity_z))
            gain = dot3(v, add3(vector(after + 4, mask), -rest, free)) / tl.where(mask, inverse, 1.0)
            tl.store(mass_bar + k, tl.load(mass_bar + k, mask, 0.0) + gain, mask)
        if HELD:
            decay = tl.where(tl.load(held + k, mask, 0) == 0, decay, 0.0)
        v = scale3(decay, v)
        store3(force_bar + node * 8, 1, 0, scale3(kick * inverse, v), mask)
    store3(own + 4, 1, 0, v, mask)


@triton.jit(do_not_specialize=VARIES)
def rows_adjoint(affected, scene, push, bars, residual, nodes, rows, BLOCK: tl.constexpr):
    """The multiplier of each held row: the transpose of what rows push, shape (rows, nodes), times the gradient."""
    row = tl.program_id(0)
    own = row // rows
    zero = tl.zeros([BLOCK], tl.float32)
    a = (zero, zero, zero)
    for start in range(0, nodes, BLOCK):
        n = start + tl.arange(0, BLOCK)
        mask = n < nodes
        mask = mask & (tl.load(scene + n, mask, -1) == own)
        b = tl.load(push + (row - own * rows) * nodes + n, mask, 0.0)
        place = bars + tl.load(affected + n, mask, 0) * 8 + 4
        a = add3(a, b, vector(place, mask))
    for c in tl.static_range(3):
        tl.store(residual + row * 4 + c, tl.sum(a[c], 0))


@triton.jit(do_not_specialize=VARIES)
def hold_adjoint(
    affected, scene, weight, residual, nodes, rows, bars,
    weight_bar, multipliers, all_rows, inverse_mass, history, active_count, first_step, step_offset, last,
    WEIGHTS: tl.constexpr, BLOCK: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Subtract the rows, with weights of shape (nodes, rows), times their multipliers from the gradient.

    WEIGHTS adds the gradient by the weights: less the forward multiplier times the gradient by the momentum, and less
    that of the gradient times the velocity after the substep.
    """
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = n < nodes
    first = tl.load(scene + n, mask, 0) * rows
    zero = tl.zeros([BLOCK], tl.float32)
    a = (zero, zero, zero)
    for start in range(0, rows, ROWS):
        k = start + tl.arange(0, ROWS)
        known = mask[:, None] & (k < rows)[None, :]
        b = tl.load(weight + n[:, None] * rows + k[None, :], known, 0.0)
        place = residual + (first[:, None] + k[None, :]) * 4
        a = add3(a, 1.0, sums(scale3(b, vector(place, known)), 1))
    own = tl.load(affected + n, mask, 0)
    at = bars + own * 8 + 4
    a = add3(vector(at, mask), -1.0, a)
    store3(at, 1, 0, a, mask)
    if WEIGHTS:
        step = tl.load(last) - tl.load(first_step) - step_offset
        inverse = tl.load(inverse_mass + own, mask, 0.0)
        after = history + ((step + 1).to(tl.int64) * active_count + own) * 8 + 4
        v = vector(after, mask)
        pushed = multipliers + step * all_rows * 4
        for start in range(0, rows, ROWS):
            k = start + tl.arange(0, ROWS)
            known = mask[:, None] & (k < rows)[None, :]
            place = (first[:, None] + k[None, :]) * 4
            held, moved = vector(residual + place, known), vector(pushed + place, known)
            to = weight_bar + n[:, None] * rows + k[None, :]
            bar = v[0][:, None] * held[0]
            for c in tl.static_range(1, 3):
                bar += v[c][:, None] * held[c]
            for c in tl.static_range(3):
                bar += (inverse * a[c])[:, None] * moved[c]
            tl.store(to, tl.load(to, known, 0.0) - bar, known)
