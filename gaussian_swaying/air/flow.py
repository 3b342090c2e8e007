"""A lattice Boltzmann flow in a box: inflow, outflow, ground and still walls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from gaussian_swaying.air.collision import MOMENTS, collide, population, sums
from gaussian_swaying.air.lattice import DIRECTIONS, OPPOSITE, SOUND, WEIGHTS, LatticeUnits
from gaussian_swaying.kernels.launch import replaces

FLUID, WALL, HELD = range(3)
MOST_CELLS = 2**31 // MOMENTS
"""Cells are counted in 32 bits."""

Face = Literal["periodic", "wall", "open"]


@dataclass(frozen=True, slots=True)
class FlowState:
    """The part of a flow that changes.

    Attributes:
        moments: Ten numbers for each cell after its collision, in units of the lattice (see :mod:`collision`), shape
            (10, X, Y, Z).
    """

    moments: Tensor


class LatticeFlow(nn.Module):
    """A flow on a box of cubic cells: D3Q27, a regularised collision with third-order terms, Smagorinsky's model.

    A wall lies halfway between the centres of a wall cell and its neighbour (bounce-back), or, where its shape is given
    as a function, where it is (interpolated bounce-back of Bouzidi, Firdaouss and Lallemand 2001, Phys. Fluids 13); it
    may move along its surface. The outermost cells of a ``wall`` face are wall cells. Those of an ``open`` face have
    the velocity of the wind and the pressure of their neighbour where the wind blows in or along the face (sound may
    leave, see :func:`hold`), and the pressure at rest and the velocity of their neighbour where it blows out. In
    float32 the step runs as compiled kernels on a GPU and on a CPU; :meth:`step` in float64 is their definition.

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
        self.kind: Tensor
        self.held: Tensor
        self.behind: Tensor
        self.outward: Tensor
        self.special: Tensor
        self.gaps: Tensor
        if solid is not None:
            self.gaps = _gaps(kind, self.special.long(), solid)

    @property
    def has_walls(self) -> bool:
        return bool((self.kind == WALL).any())

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
            dtype: Precision; kernels take float32.
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
            state: The state now.
            part: The wall cells, bool, shape (X, Y, Z), away from the faces: the pressure at rest is left out, which
                pushes a closed surface nowhere.
        """
        flat = state.moments.reshape(MOMENTS, -1)

        def sent(number: int, cells: Tensor) -> Tensor:
            return population(flat[:, cells], number)

        total = [torch.zeros((), dtype=torch.float64, device=part.device)] * 3
        for number, c in enumerate(DIRECTIONS):
            arrived, source = self._arrived(state.moments, number, sent)
            back = sent(OPPOSITE[number], self.special.long())
            given = ((back + arrived) * part.reshape(-1)[source]).double().sum()
            total = [t - a * given for t, a in zip(total, c, strict=True)]
        return torch.stack(total) * self.units.cell_mass * self.units.speed / self.units.dt

    def _arrived(self, moments: Tensor, number: int, sent: Callable[[int, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """A population that arrives at special cells, and the flat index of the cells that it comes from, (S,) each."""
        flat, special, c = moments.reshape(MOMENTS, -1), self.special.long(), DIRECTIONS[number]
        source, away = (_neighbour(special, self.cells, step) for step in (tuple(-a for a in c), c))
        pushed = 6 * WEIGHTS[number] * sum(a * flat[1 + k, source] for k, a in enumerate(c))
        back = sent(OPPOSITE[number], special) + pushed
        if len(self.gaps):
            gap = self.gaps[number].to(moments)
            near = 2 * gap * (back - pushed) + (1 - 2 * gap) * sent(OPPOSITE[number], away) + pushed
            far = (back + (2 * gap - 1) * sent(number, special)) / (2 * gap)
            back = torch.where(gap < 0.5, near, far)
        return torch.where(self.kind.reshape(-1)[source] == WALL, back, sent(number, source)), source

    def step(
        self, state: FlowState, wind: Tensor | None = None, acceleration: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> FlowState:
        """Advance by one time step.

        Args:
            state: The state now.
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
        push = [a * self.units.dt / self.units.speed for a in acceleration]
        held = self._held(wind, moments)
        if replaces([moments]):
            from gaussian_swaying.air.flow_kernels import step

            step(self, moments, out, held, push)
            return
        self._step(moments, out, push)
        if len(self.held):
            hold(out, self.held.long(), self.behind.long(), self.outward, held)

    def _held(self, wind: Tensor | None, like: Tensor) -> Tensor:
        """The wind at the cells of open faces in lattice units, shape (H, 3)."""
        given = like.new_zeros(3) if wind is None else wind.to(like) / self.units.speed
        return given.expand(len(self.held), 3).contiguous()

    def _step(self, moments: Tensor, out: Tensor, push: list[float]) -> None:
        wall = self.kind == WALL
        special, arrived = self.special.long(), []
        populations = [population(moments, number) for number in range(len(DIRECTIONS))]
        for number, c in enumerate(DIRECTIONS):
            moved = torch.roll(populations[number], c, (0, 1, 2))
            if self.has_walls:
                come, _ = self._arrived(moments, number, lambda k, cells: populations[k].reshape(-1)[cells])
                moved.reshape(-1)[special] = come
            arrived.append(moved)
        given = moments.new_tensor(push)[:, None, None, None] if any(push) else None
        out.copy_(collide(*sums(arrived), self.units.relaxation, self.smagorinsky, given))
        out.copy_(torch.where(wall, moments, out))


def hold(moments: Tensor, held: Tensor, behind: Tensor, outward: Tensor, wind: Tensor) -> None:
    r"""Set the cells of open faces, in place.

    Where the wind does not blow out, they have its velocity and what lets sound leave: a wave that arrives with a
    pressure p has the velocity :math:`p / (\rho c)`, which is added along the outward normal (c is the speed of sound).
    At low Mach numbers this is small beside the wind, and without it sound would go to and fro between the faces.

    Args:
        moments: Shape (10, X, Y, Z).
        held: Flat index of the cells, shape (H,).
        behind: Flat index of the cells behind them in the box, shape (H,).
        outward: From there to them [cells], shape (H, 3).
        wind: Velocity of the wind [cells per step], shape (H, 3).
    """
    flat = moments.reshape(MOMENTS, -1)
    near = flat[:, behind]
    out = (wind * outward.to(wind)).sum(-1) > 1e-6
    leaving = near[1:4].T
    into = (leaving * outward.to(wind)).sum(-1, keepdim=True).clamp(max=0)  # nothing flows back in
    leaving = leaving - into * outward.to(wind) / outward.to(wind).square().sum(-1, keepdim=True)
    flat[0, held] = torch.where(out, 0.0, near[0])
    normal = outward.to(wind) / outward.to(wind).square().sum(-1, keepdim=True).sqrt()
    flat[1:4, held] = torch.where(out[:, None], leaving, wind + SOUND * near[0][:, None] * normal).T
    flat[4:, held] = near[4:]


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
