r"""A lattice Boltzmann flow in a box: inflow, outflow, ground and still walls.

The collision is regularised, with a Smagorinsky model of what the cells do not resolve. After it the 27 populations of
a cell follow from ten moments, so only these are kept:

.. math:: \delta\rho = \rho - 1, \quad \mathbf u, \quad N = \Pi^{neq} \text{ after the collision},

as ``moments`` of shape (10, ...): density, velocity (x, y, z), and xx, yy, zz, xy, xz, yz of N, in units of the
lattice. The populations are the Hermite series up to third order with the recursive coefficients of Malaspinas (2015,
arXiv:1505.06900),

.. math:: f_i = w_i \Bigl(\rho + 3\,\mathbf c_i\cdot\rho\mathbf u
    + \tfrac92 \mathcal H^{(2)}_i : (\rho\mathbf{uu} + N) + \tfrac{27}{6} \mathcal H^{(3)}_i \vdots\, a^{(3)}\Bigr),
    \qquad a^{(3)}_{abc} = \rho u_a u_b u_c + u_a N_{bc} + u_b N_{ac} + u_c N_{ab}

A cell reads ten moments of each neighbour and makes of them the population that arrives, so that 40 bytes are kept for
a cell instead of 108 for its populations.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from gaussian_swaying.geometry.linalg_triton import add3, chosen, dot3, load3, store3, where3
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch

DIRECTIONS: tuple[tuple[int, int, int], ...] = tuple(itertools.product((0, 1, -1), (0, 1, -1), (0, 1, -1)))
"""The velocities [cells per step] of the lattice D3Q27, the one at rest first."""

SOUND = 1 / math.sqrt(3)
"""Speed of sound [cells per step]."""

FASTEST = 0.3
"""Largest speed [cells per step] at which the error of compressibility, some u² / c², may be called small."""

MOMENTS = 10
"""Numbers that are kept for a cell."""

FLUID, WALL, HELD = range(3)
MOST_CELLS = 2**31 // MOMENTS
"""Cells are counted in 32 bits."""

Face = Literal["periodic", "wall", "open"]


BLOCK = 128
CPU_BLOCK = 16


@triton.jit
def _load_moments(moments, at, count, mask):
    found = ()
    for q in tl.static_range(10):
        found = found + (tl.load(moments + q * count + at, mask, 0.0),)
    return found


@triton.jit
def weight(x, y, z):
    """36 times the weight of the velocity (x, y, z) of the lattice over its value at rest."""
    return (4.0 - 3.0 * x * x) * (4.0 - 3.0 * y * y) * (4.0 - 3.0 * z * z) * 0.027777777777777776


@triton.jit
def population(m, cx, cy, cz):
    """The population of one velocity, less its weight, so that small differences keep their digits."""
    rho = 1.0 + m[0]
    x = m[1]
    y = m[2]
    z = m[3]
    xx = rho * x * x + m[4]
    yy = rho * y * y + m[5]
    zz = rho * z * z + m[6]
    hx = 4.5 * (cx * cx) - 1.5
    hy = 4.5 * (cy * cy) - 1.5
    hz = 4.5 * (cz * cz) - 1.5
    total = m[0] + hx * xx + hy * yy + hz * zz + 3.0 * rho * (cx * x + cy * y + cz * z)
    total += 3.0 * cx * (hy * (x * yy + 2.0 * y * m[7]) + hz * (x * zz + 2.0 * z * m[8]))
    total += 3.0 * cy * (hx * (y * xx + 2.0 * x * m[7]) + hz * (y * zz + 2.0 * z * m[9]))
    total += 3.0 * cz * (hx * (z * xx + 2.0 * x * m[8]) + hy * (z * yy + 2.0 * y * m[9]))
    total += 9.0 * (cx * cy * (rho * x * y + m[7]) + cx * cz * (rho * x * z + m[8]) + cy * cz * (rho * y * z + m[9]))
    total += 27.0 * (cx * cy * cz) * (rho * x * y * z + x * m[9] + y * m[8] + z * m[7])
    return 0.16666666666666666 * weight(cx, cy, cz) * total


@triton.jit
def returned(own, beyond, wall, gap, cx, cy, cz, CURVED: tl.constexpr):
    """The population that comes back from a wall, at a share of the way to its cell if that is ``CURVED``."""
    pushed = weight(cx, cy, cz) * (cx * wall[1] + cy * wall[2] + cz * wall[3])
    back = population(own, -cx, -cy, -cz) + pushed
    if CURVED:
        near = 2.0 * gap * (back - pushed) + (1.0 - 2.0 * gap) * population(beyond, -cx, -cy, -cz) + pushed
        far = (back + (2.0 * gap - 1.0) * population(own, cx, cy, cz)) / (2.0 * tl.maximum(gap, 0.25))
        back = tl.where(gap < 0.5, near, far)
    return back


@triton.jit
def gather(s, f, cx, cy, cz):
    """Add a population to the sums: density, momentum and second moment, less those at rest."""
    a, x, y, z, xx, yy, zz, xy, xz, yz = s
    fx = cx * f
    fy = cy * f
    fz = cz * f
    return (
        a + f, x + fx, y + fy, z + fz, xx + cx * fx, yy + cy * fy, zz + cz * fz, xy + cy * fx, xz + cz * fx,
        yz + cz * fy,
    )  # fmt: skip


@triton.jit
def collide(s, relaxation, smagorinsky, px, py, pz):
    r"""The moments after a collision, from the sums of the populations that arrived; mass and momentum are kept.

    The eddy viscosity of Smagorinsky is :math:`\nu_t = (C_s h)^2 |S|`. Its strain rate follows from the stress before
    the collision, :math:`S = -\tfrac{3}{2\rho\tau}\Pi^{neq}`, which gives a quadratic equation for the relaxation time
    (Hou and others 1996):

    .. math:: \tau = \tfrac12 \Bigl(\tau_0 + \sqrt{\tau_0^2 + 18\sqrt2\, C_s^2 \sqrt{\Pi^{neq}:\Pi^{neq}} / \rho}\Bigr)

    ``relaxation`` is that of the molecular viscosity [steps], ``smagorinsky`` is 18 sqrt(2) C². The push of a force is
    added to the velocity of the equilibrium (exact difference, Kupershtokh 2004); the velocity at the time of the step
    has half of it.
    """
    rho = 1.0 + s[0]
    x = s[1] / rho
    y = s[2] / rho
    z = s[3] / rho
    rest = s[0] * 0.3333333333333333
    xx = s[4] - rho * x * x - rest
    yy = s[5] - rho * y * y - rest
    zz = s[6] - rho * z * z - rest
    xy = s[7] - rho * x * y
    xz = s[8] - rho * x * z
    yz = s[9] - rho * y * z
    square = xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)
    time = 0.5 * (relaxation + tl.sqrt(relaxation * relaxation + smagorinsky * tl.sqrt(square) / rho))
    kept = 1.0 - 1.0 / time
    return (s[0], x + px, y + py, z + pz, kept * xx, kept * yy, kept * zz, kept * xy, kept * xz, kept * yz)


@triton.jit
def flow_step(
    moments, out, kind, count, sx, sy, sz, relaxation, smagorinsky, px, py, pz, BLOCK: tl.constexpr,
):  # fmt: skip
    """Stream and collide, one cell per lane. Cells at faces and beside walls get wrong numbers, to be replaced."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < count
    zero = tl.zeros((BLOCK,), tl.float32)
    s = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
    for i in range(3):  # only the last loop is unrolled: a kernel for all 27 directions compiles for minutes
        for j in range(3):
            for k in tl.static_range(3):
                source = at - ((i - 1) * sx + (j - 1) * sy + (k - 1) * sz)
                m = _load_moments(moments, source, count, mask & (source >= 0) & (source < count))
                cx = 1.0 * i - 1.0
                cy = 1.0 * j - 1.0
                cz = 1.0 * k - 1.0
                s = gather(s, population(m, cx, cy, cz), cx, cy, cz)
    s = collide(s, relaxation, smagorinsky, px, py, pz)
    own = _load_moments(moments, at, count, mask)
    wall = tl.load(kind + at, mask, 1) == 1
    for q in tl.static_range(10):
        tl.store(out + q * count + at, tl.where(wall, own[q], s[q]), mask)


@triton.jit
def _wrapped(x, n):
    return tl.where(x < 0, x + n, tl.where(x >= n, x - n, x))


@triton.jit
def special_step(
    moments, out, kind, special, gaps, specials, count, nx, ny, nz, relaxation, smagorinsky, px, py, pz,
    CURVED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """As :func:`flow_step`, for cells with a neighbour that is a wall or lies behind a periodic face."""
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = lane < specials
    at = tl.load(special + lane, mask, 0)
    x = at // (ny * nz)
    y = (at // nz) % ny
    z = at % nz
    own = _load_moments(moments, at, count, mask)
    zero = tl.zeros((BLOCK,), tl.float32)
    s = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
    for i in range(3):
        for j in range(3):
            for k in tl.static_range(3):
                cx = 1.0 * i - 1.0
                cy = 1.0 * j - 1.0
                cz = 1.0 * k - 1.0
                source = (_wrapped(x - (i - 1), nx) * ny + _wrapped(y - (j - 1), ny)) * nz + _wrapped(z - (k - 1), nz)
                wall = tl.load(kind + source, mask, 0) == 1
                m = _load_moments(moments, source, count, mask)
                beyond = own
                gap = 0.5
                if CURVED:
                    away = (_wrapped(x + (i - 1), nx) * ny + _wrapped(y + (j - 1), ny)) * nz + _wrapped(z + (k - 1), nz)
                    beyond = _load_moments(moments, away, count, mask)
                    row = 9 * ((i + 2) % 3) + 3 * ((j + 2) % 3) + (k + 2) % 3  # as in DIRECTIONS
                    gap = tl.load(gaps + row * specials + lane, mask, 0.5)
                back = returned(own, beyond, m, gap, cx, cy, cz, CURVED)
                f = tl.where(wall, back, population(m, cx, cy, cz))
                s = gather(s, f, cx, cy, cz)
    s = collide(s, relaxation, smagorinsky, px, py, pz)
    for q in tl.static_range(10):
        tl.store(out + q * count + at, s[q], mask)


@triton.jit
def hold_faces(moments, held, behind, outward, wind, cells, count, BLOCK: tl.constexpr):
    r"""Set the cells of open faces, one per lane.

    Where the wind does not blow out, they have its velocity and what lets sound leave: a wave that arrives with a
    pressure p has the velocity :math:`p / (\rho c)`, which is added along the outward normal (c is the speed of sound).
    At low Mach numbers this is small beside the wind, and without it sound would go to and fro between the faces.
    """
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = lane < cells
    at = tl.load(held + lane, mask, 0)
    near = _load_moments(moments, tl.load(behind + lane, mask, 0), count, mask)
    away = load3(outward, 1, 3 * lane, mask)
    blown = load3(wind, 1, 3 * lane, mask)
    leaving = chosen(near, 1, 3)
    square = tl.where(mask, dot3(away, away), 1.0)
    out = dot3(blown, away) > 1e-6
    leaving = add3(leaving, -tl.minimum(dot3(leaving, away), 0.0) / square, away)
    blown = add3(blown, 0.5773502691896258 * near[0] / tl.sqrt(square), away)
    tl.store(moments + at, tl.where(out, 0.0, near[0]), mask)
    store3(moments + count, count, at, where3(out, leaving, blown), mask)
    for q in tl.static_range(4, 10):
        tl.store(moments + q * count + at, near[q], mask)


@dataclass(frozen=True)
class LatticeUnits:
    """Metres and seconds on a lattice.

    Attributes:
        spacing: Side of a cell [m].
        dt: Time step [s].
        viscosity: Kinematic viscosity of the fluid [m²/s].
        density: Its density [kg/m³].
    """

    spacing: float
    dt: float
    viscosity: float
    density: float

    @classmethod
    def at_speed(
        cls, spacing: float, speed: float, *, lattice_speed: float = 0.1, viscosity: float, density: float
    ) -> LatticeUnits:
        """Units in which a speed [m/s] is ``lattice_speed`` cells per step."""
        return cls(float(spacing), lattice_speed * spacing / speed, float(viscosity), float(density))

    @property
    def speed(self) -> float:
        """One cell per step [m/s]."""
        return self.spacing / self.dt

    @property
    def relaxation(self) -> float:
        """Relaxation time of the molecular viscosity [steps], 1/2 + 3 nu dt / h²."""
        return 0.5 + 3 * self.viscosity * self.dt / self.spacing**2

    @property
    def cell_mass(self) -> float:
        """Mass of the air in a cell [kg]."""
        return self.density * self.spacing**3


@dataclass(frozen=True, slots=True)
class FlowState:
    """The part of a flow that changes.

    Attributes:
        moments: Ten numbers for each cell after its collision, in units of the lattice (see above), shape
            (10, X, Y, Z).
    """

    moments: Tensor


class LatticeFlow(nn.Module):
    """A flow on a box of cubic cells: D3Q27, a regularised collision with third-order terms, Smagorinsky's model.

    A wall given by its cells lies halfway between a wall cell and its neighbour (bounce-back). One given by a function
    lies exactly where the function says (interpolated bounce-back: Bouzidi, Firdaouss and Lallemand 2001, Phys. Fluids
    13). Walls may move along their surface. The outermost cells of a ``wall`` face are wall cells. Cells of an ``open``
    face take the velocity of the wind and the pressure of their neighbour where the wind blows in (sound may leave, see
    :func:`hold_faces`), and the pressure at rest and the velocity of their neighbour where it blows out. Kernels take
    float32, on a CPU also float64.

    Args:
        cells: Cells along x, y and z. With one cell along an axis, which must be periodic, the flow is two-dimensional.
        units: Metres and seconds of the lattice.
        faces: ``periodic``, ``wall`` or ``open`` for each axis; or two of them, for its low and high face.
        walls: Wall cells, bool, shape (X, Y, Z); or a function that tells of places, in cells from the lower corner of
            the box, shape (..., 3), whether they lie in a wall, shape (...). None for none but those of the faces.
        smagorinsky: Constant of the subgrid model; 0 for none. Published values lie between 0.1 and 0.2.

    Attributes:
        kind: 0 for air, 1 for a wall, 2 for a cell of an open face, int8, shape (X, Y, Z).
        held: Flat index of the cells of open faces, int32, shape (H,).

    Raises:
        ValueError: If there are too few or too many cells.

    Example:
        >>> units = LatticeUnits.at_speed(0.1, 1.0, viscosity=1e-2, density=1.2)
        >>> flow = LatticeFlow((8, 8, 8), units, faces=("periodic", "periodic", "periodic"))
        >>> state = flow.step(flow.start([1.0, 0.0, 0.0]))
        >>> flow.velocity(state)[:, 0, 0, 0]
        tensor([1., 0., 0.])
    """

    kind: Tensor
    held: Tensor
    behind: Tensor
    outward: Tensor
    special: Tensor
    gaps: Tensor

    def __init__(
        self,
        cells: Sequence[int],
        units: LatticeUnits,
        *,
        faces: Sequence[Face | tuple[Face, Face]] = ("open", "open", "open"),
        walls: Tensor | Callable[[Tensor], Tensor] | None = None,
        smagorinsky: float = 0.1,
    ) -> None:
        super().__init__()
        sides = [face if isinstance(face, tuple) else (face, face) for face in faces]
        for axis, (count, pair) in enumerate(zip(cells, sides, strict=True)):
            if pair[0] != "periodic" and count < 4:
                raise ValueError(f"Expected at least 4 `cells` along axis {axis}, whose faces are {pair}: got {count}.")
        shape = (int(cells[0]), int(cells[1]), int(cells[2]))
        if shape[0] * shape[1] * shape[2] > MOST_CELLS:
            raise ValueError(f"Expected at most {MOST_CELLS:,} `cells` in all, but got {shape}.")
        self.cells, self.units, self.smagorinsky = shape, units, float(smagorinsky)
        kind = torch.zeros(shape, dtype=torch.int8)
        for axis, pair in enumerate(sides):
            for side, end in zip(pair, (0, shape[axis] - 1), strict=True):
                layer = kind.select(axis, end)
                if side == "open":
                    layer[layer != WALL] = HELD
                elif side == "wall":
                    layer.fill_(WALL)
        solid = walls if callable(walls) and not isinstance(walls, Tensor) else None
        if solid is not None:
            axes = [torch.arange(n, dtype=torch.float64) + 0.5 for n in shape]
            walls = solid(torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)).bool()
        if isinstance(walls, Tensor):
            kind[walls.cpu()] = WALL
        place = (kind == HELD).nonzero()
        low = torch.tensor([int(pair[0] == "open") for pair in sides])
        high = torch.tensor([n - 1 - int(pair[1] == "open") for n, pair in zip(shape, sides, strict=True)])
        inner = torch.minimum(torch.maximum(place, low), high)
        strides = torch.tensor([shape[1] * shape[2], shape[2], 1])
        for name, value in (
            ("kind", kind),
            ("held", (place * strides).sum(-1).int()),
            ("behind", (inner * strides).sum(-1).int()),
            ("outward", (place - inner).float().contiguous()),
            ("special", _special(kind)),
            ("gaps", torch.zeros(0)),
        ):
            self.register_buffer(name, value, persistent=False)
        if solid is not None:
            self.gaps = _gaps(kind, self.special.long(), solid)

    def start(
        self,
        velocity: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        wall_velocity: Tensor | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> FlowState:
        """A flow at the pressure at rest.

        Args:
            velocity: Of the air [m/s], three numbers or broadcastable to (3, X, Y, Z).
            wall_velocity: Of the walls [m/s], along their surface, shape (3, X, Y, Z); still if None.
            dtype: Precision; float64 on a CPU alone.
        """
        moments = torch.zeros(MOMENTS, *self.cells, dtype=dtype, device=self.kind.device)
        given = torch.as_tensor(velocity, dtype=dtype, device=self.kind.device)
        moments[1:4] = (given if given.ndim > 1 else given[:, None, None, None]) / self.units.speed
        wall = self.kind == WALL
        moments[1:4] = torch.where(
            wall, 0.0 if wall_velocity is None else wall_velocity / self.units.speed, moments[1:4]
        )
        return FlowState(moments)

    def velocity(self, state: FlowState) -> Tensor:
        """Velocity of the air [m/s], shape (3, X, Y, Z); in walls that of the wall."""
        return state.moments[1:4] * self.units.speed

    def vorticity(self, state: FlowState) -> Tensor:
        """Curl of the velocity [1/s] by central differences, shape (3, X, Y, Z); 0 along axes of one cell."""
        velocity, h = self.velocity(state), self.units.spacing

        def slope(part: int, axis: int) -> Tensor:
            field = velocity[part]
            return torch.gradient(field, spacing=h, dim=axis)[0] if field.shape[axis] > 1 else torch.zeros_like(field)

        return torch.stack([slope(2, 1) - slope(1, 2), slope(0, 2) - slope(2, 0), slope(1, 0) - slope(0, 1)])

    def momentum(self, state: FlowState) -> Tensor:
        """Momentum of the air in the box [kg m/s], shape (3,), float64."""
        mass = (1 + state.moments[0].double()) * (self.kind == FLUID)
        return (mass * state.moments[1:4].double()).sum((1, 2, 3)) * self.units.cell_mass * self.units.speed

    def force_on_walls(self, state: FlowState, part: Tensor) -> Tensor:
        """Force of the air on some wall cells in the next step [N], shape (3,), float64: the momentum of what returns.

        Args:
            part: The wall cells, bool, shape (X, Y, Z), away from the faces: the pressure at rest is left out, which
                pushes a closed surface nowhere.
        """
        flat, special, curved = state.moments.reshape(MOMENTS, -1), self.special.long(), len(self.gaps) > 0
        total = [torch.zeros((), dtype=torch.float64, device=part.device)] * 3
        for number, c in enumerate(DIRECTIONS):
            back = tuple(-a for a in c)
            source, away = (_neighbour(special, self.cells, step) for step in (back, c))
            own, wall, beyond = (flat[:, cells].unbind() for cells in (special, source, away))
            gap = self.gaps[number].to(flat) if curved else 0.5
            arrived = on_tensors(returned)(own, beyond, wall, gap, *c, curved)
            given = (on_tensors(population)(own, *back) + arrived) * part.reshape(-1)[source]
            total = [t - a * given.double().sum() for t, a in zip(total, c, strict=True)]
        return torch.stack(total) * self.units.cell_mass * self.units.speed / self.units.dt

    def step(
        self, state: FlowState, wind: Tensor | None = None, acceleration: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> FlowState:
        """Advance by one time step.

        Args:
            wind: Velocity [m/s] at the cells of open faces, shape (3,) or (H, 3); still if None.
            acceleration: Of all the air [m/s²].
        """
        out = torch.empty_like(state.moments)
        self.advance(state.moments, out, wind, acceleration)
        return FlowState(out)

    def advance(
        self, moments: Tensor, out: Tensor, wind: Tensor | None = None, acceleration: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        """As :meth:`step`, into a given tensor."""
        block = lanes(moments.device, BLOCK, CPU_BLOCK)
        nx, ny, nz = self.cells
        count = nx * ny * nz
        push = [a * self.units.dt / self.units.speed for a in acceleration]
        numbers = (self.units.relaxation, 18 * 2**0.5 * self.smagorinsky**2, *push)
        strides = (ny * nz if nx > 1 else 0, nz if ny > 1 else 0, 1 if nz > 1 else 0)
        launch(flow_step, (triton.cdiv(count, block),))(moments, out, self.kind, count, *strides, *numbers, BLOCK=block)
        if len(self.special):
            launch(special_step, (triton.cdiv(len(self.special), block),))(
                moments, out, self.kind, self.special, self.gaps.to(moments), len(self.special), count, nx, ny, nz,
                *numbers, CURVED=len(self.gaps) > 0, BLOCK=block,
            )  # fmt: skip
        self.hold(out, wind)

    def hold(self, moments: Tensor, wind: Tensor | None = None) -> None:
        """Set the cells of open faces in a wind [m/s], in place."""
        if len(self.held):
            block = lanes(moments.device, BLOCK, CPU_BLOCK)
            given = moments.new_zeros(3) if wind is None else wind.to(moments) / self.units.speed
            launch(hold_faces, (triton.cdiv(len(self.held), block),))(
                moments, self.held, self.behind, self.outward.to(moments), given.expand(len(self.held), 3).contiguous(),
                len(self.held), self.kind.numel(), BLOCK=block,
            )  # fmt: skip


def _neighbour(cell: Tensor, cells: tuple[int, int, int], step: Sequence[int]) -> Tensor:
    """Flat index of the neighbours of cells, shape (S,), across periodic faces."""
    _, ny, nz = cells
    place = (cell // (ny * nz), cell // nz % ny, cell % nz)
    x, y, z = (torch.remainder(p + s, n) for p, s, n in zip(place, step, cells, strict=True))
    return (x * ny + y) * nz + z


def _gaps(kind: Tensor, special: Tensor, solid: Callable[[Tensor], Tensor]) -> Tensor:
    """Share of the way to the wall cell at which the wall lies, for each velocity and special cell, float32, (27, S).

    One half where there is no wall, or no air on the other side to interpolate with.
    """
    cells = (int(kind.shape[0]), int(kind.shape[1]), int(kind.shape[2]))
    flat, gaps = kind.reshape(-1), torch.full((len(DIRECTIONS), len(special)), 0.5)
    _, ny, nz = cells
    place = torch.stack([special // (ny * nz), special // nz % ny, special % nz], -1).double() + 0.5
    for number, c in enumerate(DIRECTIONS):
        source, away = (_neighbour(special, cells, step) for step in (tuple(-a for a in c), c))
        chosen = (flat[source] == WALL) & (flat[away] != WALL)
        start, way = place[chosen], -torch.tensor(c, dtype=torch.float64)
        chosen[chosen.clone()] = inside = solid(start + way).bool()  # walls of faces lie halfway
        start = start[inside]
        low, high = torch.zeros(len(start), dtype=torch.float64), torch.ones(len(start), dtype=torch.float64)
        for _ in range(16):
            middle = 0.5 * (low + high)
            within = solid(start + middle[:, None] * way).bool()
            low, high = torch.where(within, low, middle), torch.where(within, middle, high)
        gaps[number, chosen] = high.float()
    return gaps


def _special(kind: Tensor) -> Tensor:
    """Cells of air with a neighbour that is a wall or lies behind a periodic face, int32, shape (S,)."""
    found = torch.zeros(kind.shape, dtype=torch.bool)
    for c in DIRECTIONS:
        found |= torch.roll(kind == WALL, c, (0, 1, 2))
    for axis, count in enumerate(kind.shape):
        if count > 1:
            found.select(axis, 0).fill_(True)
            found.select(axis, count - 1).fill_(True)
    return (found & (kind == FLUID)).reshape(-1).nonzero()[:, 0].int()
