"""Kernels of the ``total`` substep; the reference is :mod:`~gaussian_swaying.mpm.total`.

Stencils do not move, so particles are sorted by cell once. A program handles some cells with up to ``LANES`` particles
at a time, reads nodal displacements and velocities, and writes 27 sums per cell; each node then gathers the sums of the
cells around it. Points that are held all the time are stopped by two more kernels. No atomics: the result is the same
in every run.

Rows of node arrays: displacement and velocity, each in four columns of eight, a sector of memory. The sums have four
columns, or eight if boundaries need positions.
"""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    axpy9,
    columns9,
    load3,
    plus_identity,
    rows,
    scale3,
    scale9,
    store3,
    store9,
    transpose,
    where3,
)
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.damping import kelvin_voigt
from gaussian_swaying.mpm.dispatch import ROW, pk1
from gaussian_swaying.mpm.shared_kernels import (
    VARIES,
    account,
    add_given,
    axis_weights,
    keep_largest,
    load_four,
    node_weight,
    sum_of_forces,
    sums,
    vector,
    wave_speed,
)
from gaussian_swaying.mpm.sheets import flattened, sheet_pk1, without_normal


@triton.jit
def gather(
    field, node, sx, sy, f, wz, gz, inverse_dx, mask, BOTH: tl.constexpr,
    table=None, columns=0, VIRTUAL: tl.constexpr = False, WIDE: tl.constexpr = False,
):  # fmt: skip
    """Interpolate columns 0 to 2 of rows of eight, their derivatives [component, axis], and (BOTH) columns 4 to 6.

    ``node`` is the first node on the lattice, or with VIRTUAL a column of a ``table`` of nodes, shape (27, columns).
    With WIDE rows are loaded by :func:`load_four`, whatever the mask says; all nodes must be in the field.
    """
    zero = (wz[0] * 0, wz[0] * 0, wz[0] * 0)
    u, v, by_x, by_y, by_z = zero, zero, zero, zero, zero
    for i in range(3):
        wx, gx = node_weight(f[0], i, inverse_dx)
        for j in tl.static_range(3):
            wy, gy = node_weight(f[1], j, inverse_dx)
            if not VIRTUAL:
                row = field + (node + i * sx + j * sy) * 8
            s, t, r = zero, zero, zero
            for k in tl.static_range(3):
                if VIRTUAL:
                    at = field + tl.load(table + ((i * 3 + j) * 3 + k) * columns + node) * 8
                else:
                    at = row + k * 8
                q = load_four(at) if WIDE else vector(at, mask)
                s = add3(s, wz[k], q)
                t = add3(t, gz[k], q)
                if BOTH:
                    r = add3(r, wz[k], load_four(at + 4) if WIDE else vector(at + 4, mask))
            w = wx * wy
            u = add3(u, w, s)
            if BOTH:
                v = add3(v, w, r)
            by_x = add3(by_x, gx * wy, s)
            by_y = add3(by_y, wx * gy, s)
            by_z = add3(by_z, w, t)
    return u, columns9(by_x, by_y, by_z), v


@triton.jit
def cells_of(cell_start, cell_node, cell_scene, cells, CELLS: tl.constexpr):
    """Cells of a program: numbers, mask, first and last particle, node, scene, and the largest number of particles.

    Node and scene have a second axis for the lanes.
    """
    cell = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    real = cell < cells
    start = tl.load(cell_start + cell, real, 0)
    end = tl.load(cell_start + cell + 1, real, 0)
    node = tl.load(cell_node + cell, real, 0)[:, None]
    scene = tl.load(cell_scene + cell, real, 0)[:, None]
    return cell, real, start, end, node, scene, tl.max(end - start)


@triton.jit
def load_particles(fraction, material, count, index, mask):
    """Place in the cell, volume, mu and lambda of some particles.

    A lane without a particle is put in the middle of the cell: outside it F might be inverted, which is slow.
    """
    f = (
        tl.load(fraction + index, mask, 1.0),
        tl.load(fraction + count + index, mask, 1.0),
        tl.load(fraction + 2 * count + index, mask, 1.0),
    )
    volume = tl.load(material + index, mask, 0.0)
    mu = tl.load(material + count + index, mask, 0.0)
    lam = tl.load(material + 2 * count + index, mask, 0.0)
    return f, volume, mu, lam


@triton.jit
def motion(
    fields, node, sx, sy, f, wz, gz, inverse_dx, known, VISCOUS: tl.constexpr, MOVING: tl.constexpr,
    table=None, columns=0, VIRTUAL: tl.constexpr = False, WIDE: tl.constexpr = False,
):  # fmt: skip
    """Displacement, F, velocity (with VISCOUS or MOVING) and the velocity's gradient (with VISCOUS) of particles."""
    BOTH: tl.constexpr = MOVING and not VISCOUS
    u, F, v = gather(fields, node, sx, sy, f, wz, gz, inverse_dx, known, BOTH, table, columns, VIRTUAL, WIDE)
    rate = F
    if VISCOUS:
        v, rate, _v = gather(
            fields + 4, node, sx, sy, f, wz, gz, inverse_dx, known, False, table, columns, VIRTUAL, WIDE
        )
    return u, plus_identity(F), v, rate


@triton.jit
def law_row(law, law_table, index, mask, MULTI: tl.constexpr):
    """Return pointers to the constants of the law of some particles."""
    if MULTI:
        row = law_table + ROW * tl.load(law + index, mask, 0)
    else:
        row = law_table
    return row


@triton.jit(do_not_specialize=VARIES)
def total_particles(
    fraction, material, normals, law, law_table, values, force_in, load, order, count,
    cell_start, cell_node, cell_scene, cells, cell_nodes,
    fields, partial,
    schedule, vectors, scenes, numbers, first_step, step_offset,
    sx, sy, ox, oy, oz, scene_size, dx, inverse_dx, viscous_time,
    LAWS: tl.constexpr, MULTI: tl.constexpr, FORCES: tl.constexpr, FORCE: tl.constexpr, IMPLICIT: tl.constexpr,
    VISCOUS: tl.constexpr, POSITION: tl.constexpr, WIDTH: tl.constexpr, CELLS: tl.constexpr, LANES: tl.constexpr,
    VIRTUAL: tl.constexpr, WIDE: tl.constexpr, SHEETS: tl.constexpr,
):  # fmt: skip
    """``total``: forces of the particles of some cells, summed into 27 rows of ``partial`` per cell.

    With VIRTUAL the nodes of each cell are columns of ``cell_nodes``, and ``cell_node`` only says where it lies.
    Lanes without a particle have no volume, values of a force or mass, so they add nothing. The first step of a
    rollout takes the previous substep from row 0 of the schedule.
    """
    LOADED: tl.constexpr = (len(FORCES.functions) > 0) or FORCE
    cell, real, start, end, node, scene, longest = cells_of(cell_start, cell_node, cell_scene, cells, CELLS)
    step = tl.load(first_step) + step_offset
    kick = tl.load(schedule + (step + 1) * 4)
    before = tl.load(schedule + step * 4)
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
        u, F, v, rate = motion(
            fields, place, sx, sy, f, wz, gz, inverse_dx, known, VISCOUS, LOADED, cell_nodes, cells, VIRTUAL, WIDE
        )
        row = law_row(law, law_table, index, mask, MULTI)
        if SHEETS:
            n = load3(normals, count, index, mask)
            stress, F = sheet_pk1(F, n, mu, lam, row, LAWS)
            if VISCOUS:
                viscous = kelvin_voigt(F, without_normal(rate, n), mu, lam, viscous_time)
                stress = axpy9(1.0, stress, 1.0, without_normal(viscous, n))
        else:
            stress = pk1(F, mu, lam, row, LAWS)
            if VISCOUS:
                stress = axpy9(1.0, stress, 1.0, kelvin_voigt(F, rate, mu, lam, viscous_time))
        stress = scale9(-volume, stress)
        zero = volume * 0
        value = (zero, zero, zero)
        resistance = zero
        if len(FORCES.functions) > 0:
            within = node - scene * scene_size
            bx = within // sx
            by = (within - bx * sx) // sy
            at = (
                (bx + ox + f[0]) * dx + u[0],
                (by + oy + f[1]) * dx + u[1],
                (within - bx * sx - by * sy + oz + f[2]) * dx + u[2],
            )
            value, resistance = sum_of_forces(
                FORCES, F, v, at, index, mask, scene, values, count, vectors, scenes, step, numbers
            )
        if FORCE:
            where = tl.load(order + index, mask, 0)
            value, resistance = add_given(value, resistance, force_in, where, mask)
        if LOADED:
            account(value, resistance, v, kick, before, IMPLICIT, load, count, index, mask)
        if POSITION:
            mass = tl.load(material + 3 * count + index, mask, 0.0)
            moved = scale3(mass, u)
        along = rows(transpose(stress))
        for i in range(3):
            wx, gx = node_weight(f[0], i, inverse_dx)
            for j in tl.static_range(3):
                wy, gy = node_weight(f[1], j, inverse_dx)
                w = wx * wy
                ax = gx * wy
                ay = wx * gy
                a = add3(add3(scale3(w, value), ax, along[0]), ay, along[1])
                for k in tl.static_range(3):
                    out = partial + (((i * 3 + j) * 3 + k) * (cells + 1) + cell) * WIDTH
                    gw = gz[k] * w
                    s = sums(axpy3(wz[k], a, gw, along[2]), 1)
                    if chunk > 0:
                        s = add3(s, 1.0, vector(out, real))
                    store3(out, 1, 0, s, real)
                    if IMPLICIT:
                        s3 = tl.sum(wz[k] * (w * resistance), 1)
                        if chunk > 0:
                            s3 += tl.load(out + 3, real, 0.0)
                        tl.store(out + 3, s3, real)
                    if POSITION:
                        for c in tl.static_range(3):
                            s4 = tl.sum(wz[k] * (w * moved[c]), 1)
                            if chunk > 0:
                                s4 += tl.load(out + 4 + c, real, 0.0)
                            tl.store(out + 4 + c, s4, real)


@triton.jit(do_not_specialize=VARIES)
def total_pieces(pieces_in, partial, first_piece, cells, pieces, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    """``total``: the sums of each cell from those of its pieces, always in the same order."""
    o = tl.program_id(1)
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = cell < cells
    first = tl.load(first_piece + cell, mask, 0)
    many = tl.load(first_piece + cell + 1, mask, 0) - first
    column = tl.arange(0, WIDTH)[None, :]
    total = tl.zeros([BLOCK, WIDTH], tl.float32)
    for k in range(0, tl.max(many)):
        row = (o * (pieces + 1) + first + k) * WIDTH
        total += tl.load(pieces_in + row[:, None] + column, (k < many)[:, None], 0.0)
    out = (o * (cells + 1) + cell) * WIDTH
    tl.store(partial + out[:, None] + column, total, mask[:, None])


@triton.jit(do_not_specialize=VARIES)
def total_bend(
    bent_cell, bent_node, curving, fields, partial, bent, cells, WIDTH: tl.constexpr, RANK: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """``total``: add the forces of sheets that bend by themselves to the sums of their cells.

    Each of ``bent`` cells has 27 nodes and RANK rows v of 32 columns, of which those beyond 27 are zero: the forces are
    -v (v u). What is there already is loaded first, so that the waits for the memory overlap.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = k < bent
    o = tl.arange(0, 32)[None, :]
    real = known[:, None] & (o < 27)
    out = partial + (o * (cells + 1) + tl.load(bent_cell + k, known, 0)[:, None]) * WIDTH
    f = vector(out, real)
    u = vector(fields + tl.load(bent_node + k[:, None] * 27 + o, real, 0) * 8, real)
    for r in range(RANK):
        v = tl.load(curving + (k[:, None] * RANK + r) * 32 + o, known[:, None], 0.0)
        along = sums(scale3(v, u), 1)
        f = add3(f, -v, (along[0][:, None], along[1][:, None], along[2][:, None]))
    store3(out, 1, 0, f, real)


@triton.jit(do_not_specialize=VARIES)
def total_join(source, counts, nodes, partial, joined, WIDTH: tl.constexpr):
    """``total``, on a CPU: the sums of the cells around a node, so that ``total_nodes`` has one source."""
    k = tl.program_id(0)
    column = tl.arange(0, WIDTH)
    total = tl.zeros([WIDTH], tl.float32)
    for o in range(0, tl.load(counts + k)):
        total += tl.load(partial + tl.load(source + o * nodes + k) * WIDTH + column)
    tl.store(joined + k * WIDTH + column, total)


@triton.jit
def _end(node, k, mask, v, d, inverse, held, taken, fields, dt, HELD: tl.constexpr, MOVE: tl.constexpr):
    if HELD:
        free = tl.load(held + k, mask, 0) == 0
        stopped = mask & (free == 0)
        mass = 1.0 / tl.where(stopped, inverse, 1.0)
        to = taken + k * 4
        for c in tl.static_range(3):
            tl.store(to + c, tl.load(to + c, stopped, 0.0) + mass * v[c], stopped)
        v = where3(free, v, (0.0, 0.0, 0.0))
    to = fields + node * 8
    store3(to + 4, 1, 0, v, mask)
    if MOVE:
        store3(to, 1, 0, add3(d, dt, v), mask)


@triton.jit(do_not_specialize=VARIES)
def total_nodes(
    active, source, sources, inverse_mass, rates, held, nodes, partial, fields, shift,
    schedule, first_step, step_offset, gravity_x, gravity_y, gravity_z, taken,
    IMPLICIT: tl.constexpr, POSITION: tl.constexpr, WIDTH: tl.constexpr, HELD: tl.constexpr, MOVE: tl.constexpr,
    DAMPED: tl.constexpr, BLOCK: tl.constexpr, SOURCES: tl.constexpr,
):  # fmt: skip
    """``total``: nodal velocities and displacements from the sums of the cells around each node.

    ``source`` are the rows of ``partial`` that each node adds, of which no node has more than ``sources``. Everything
    is loaded as soon as its address is known, so that the waits for the memory overlap.
    """
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    node = tl.load(active + k, mask, 0)
    o = tl.arange(0, SOURCES)[:, None]  # all at once
    known = mask[None, :] & (o < sources)
    row = partial + tl.load(source + o * nodes + k[None, :], known, 0) * WIDTH
    inverse = tl.load(inverse_mass + k, mask, 0.0)
    step = tl.load(first_step) + step_offset
    place = fields + node * 8
    v = vector(place + 4, mask)
    d = v
    if MOVE:
        d = vector(place, mask)
    kick = tl.load(schedule + (step + 1) * 4)
    dt = tl.load(schedule + (step + 1) * 4 + 1)
    decay = tl.load(schedule + (step + 1) * 4 + 2)
    if DAMPED:
        decay *= tl.exp(-kick * tl.load(rates + k, mask, 0.0))
    f = sums(vector(row, known), 0)
    if IMPLICIT:
        drag = tl.sum(tl.load(row + 3, known, 0.0), 0)
    if POSITION:
        moved = sums(vector(row + 4, known), 0)
    if IMPLICIT:
        push = kick / (1 + kick * drag * inverse)
    else:
        push = kick
    v = scale3(decay, add3(v, push, add3((gravity_x, gravity_y, gravity_z), inverse, f)))
    _end(node, k, mask, v, d, inverse, held, taken, fields, dt, HELD, MOVE)
    if POSITION:
        store3(shift + node * 4, 1, 0, scale3(inverse, moved), mask)


@triton.jit(do_not_specialize=VARIES)
def total_end(
    active, inverse_mass, held, nodes, fields, schedule, first_step, step_offset, taken,
    HELD: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``total``: the end of a substep after contact, which comes between ``total_nodes`` and it."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < nodes
    node = tl.load(active + k, mask, 0)
    inverse = tl.load(inverse_mass + k, mask, 0.0)
    step = tl.load(first_step) + step_offset
    place = fields + node * 8
    v, d = vector(place + 4, mask), vector(place, mask)
    dt = tl.load(schedule + (step + 1) * 4 + 1)
    _end(node, k, mask, v, d, inverse, held, taken, fields, dt, HELD, True)


@triton.jit(do_not_specialize=VARIES)
def total_rows(node, weight, rows, fields, residual, BLOCK: tl.constexpr):
    """``total``: velocities of the held points, and their sums since the start of the rollout."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < rows
    o = tl.arange(0, 32)[None, :]  # all 27 at once: one after the other would wait 27 times for the memory
    each = o * rows + k[:, None]
    known = mask[:, None] & (o < 27)
    place = fields + tl.load(node + each, known, 0) * 8 + 4
    w = tl.load(weight + each, known, 0.0)
    out = residual + k * 4
    total = out + rows * 4
    before, now = vector(total, mask), sums(scale3(w, vector(place, known)), 1)
    store3(out, 1, 0, now, mask)
    store3(total, 1, 0, add3(before, 1.0, now), mask)


@triton.jit(do_not_specialize=VARIES)
def total_hold(
    affected, scene, push, residual, nodes, rows, fields, schedule, first_step, step_offset,
    BLOCK: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """``total``: velocities and displacements of the nodes around held points, of which a scene has ``rows``."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = n < nodes
    first = tl.load(scene + n, mask, 0) * rows
    at = fields + tl.load(affected + n, mask, 0) * 8
    step = tl.load(first_step) + step_offset
    d, v = vector(at, mask), vector(at + 4, mask)
    dt = tl.load(schedule + (step + 1) * 4 + 1)
    zero = tl.zeros([BLOCK], tl.float32)
    a = (zero, zero, zero)
    for start in range(0, rows, ROWS):
        k = start + tl.arange(0, ROWS)
        known = mask[:, None] & (k < rows)[None, :]
        b = tl.load(push + n[:, None] * rows + k[None, :], known, 0.0)
        place = residual + (first[:, None] + k[None, :]) * 4
        a = add3(a, 1.0, sums(scale3(b, vector(place, known)), 1))
    store3(at, 1, 0, add3(d, -dt, a), mask)
    store3(at + 4, 1, 0, add3(v, -1.0, a), mask)


@triton.jit
def _in_plane_stress(F, material, normals, count, index, mask):
    mu = tl.load(material + count + index, mask, 1.0)
    lam = tl.load(material + 2 * count + index, mask, 0.0)
    flat, _m, _area, _thickness, _thinning = flattened(F, load3(normals, count, index, mask), mu, lam)
    return flat


@triton.jit(do_not_specialize=VARIES)
def total_read(
    fraction, material, normals, load, order, rest, count, particle_cell, cell_node, cell_nodes, cells, fields,
    kick_before, position_out, velocity_out, affine_out, F_out, sx, sy, inverse_dx,
    WORK: tl.constexpr, IMPLICIT: tl.constexpr, BLOCK: tl.constexpr, VIRTUAL: tl.constexpr, SHEETS: tl.constexpr,
):  # fmt: skip
    """``total``: the particle fields, in the order in which they were given."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = load3(fraction, count, index, mask)
    node = tl.load(particle_cell + index, mask, 0)
    if not VIRTUAL:
        node = tl.load(cell_node + node, mask, 0)
    where = tl.load(order + index, mask, 0)
    wz, gz = axis_weights(f[2], inverse_dx)
    u, F, _v = gather(fields, node, sx, sy, f, wz, gz, inverse_dx, mask, False, cell_nodes, cells, VIRTUAL)
    v, rate, _v = gather(fields + 4, node, sx, sy, f, wz, gz, inverse_dx, mask, False, cell_nodes, cells, VIRTUAL)
    if WORK:
        zero = f[0] * 0
        account((zero, zero, zero), zero, v, 0.0, tl.load(kick_before), IMPLICIT, load, count, index, mask)
    F = plus_identity(F)
    if SHEETS:
        F = _in_plane_stress(F, material, normals, count, index, mask)
    store3(position_out, 1, where * 3, add3(load3(rest, 1, where * 3, mask), 1.0, u), mask)
    store3(velocity_out, 1, where * 3, v, mask)
    store9(F_out, 1, where * 9, F, mask)
    store9(affine_out, 1, where * 9, rate, mask)


@triton.jit(do_not_specialize=VARIES)
def total_look(
    fraction, material, normals, count, particle_cell, cell_node, cell_nodes, cells, fields, out, sx, sy, inverse_dx,
    WAVE: tl.constexpr, BLOCK: tl.constexpr, VIRTUAL: tl.constexpr, SHEETS: tl.constexpr,
):  # fmt: skip
    """``total``: as ``largest_speed``, from the nodal displacements."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = load3(fraction, count, index, mask)
    node = tl.load(particle_cell + index, mask, 0)
    if not VIRTUAL:
        node = tl.load(cell_node + node, mask, 0)
    wz, gz = axis_weights(f[2], inverse_dx)
    _u, F, _v = gather(fields, node, sx, sy, f, wz, gz, inverse_dx, mask, False, cell_nodes, cells, VIRTUAL)
    F = plus_identity(F)
    if SHEETS:
        F = _in_plane_stress(F, material, normals, count, index, mask)
    mu = tl.load(material + count + index, mask, 0.0)
    lam = tl.load(material + 2 * count + index, mask, 0.0)
    density = tl.load(material + 3 * count + index, mask, 1.0) / tl.load(material + index, mask, 1.0)
    keep_largest(out, wave_speed(F, density, mu, lam, WAVE, False), mask)
