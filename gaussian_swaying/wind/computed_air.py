"""Computed air: a flow in a box around the body, which the body bends and which bends the body."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive, check_vector, check_whole
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.air.flow import (
    FASTEST,
    FLUID,
    MOMENTS,
    MOST_CELLS,
    WALL,
    Face,
    FlowState,
    LatticeFlow,
    LatticeUnits,
)
from gaussian_swaying.air.immersed import give, look, together, values_at
from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.kernels.graphs import Replayed
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.mpm.timestep import look_marks
from gaussian_swaying.wind.effects import Obstacle
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import WindForce, air_push
from gaussian_swaying.wind.tables import Shelter

LEAST_CELLS = 8
"""Cells along the longest side of the body: with fewer, no wake of it is resolved."""

LATTICE_SPEED = 0.1  # cells per step

LIGHTEST = 0.02
"""Smallest ratio of the mass of a point to that of the layer of air that it moves."""


class ComputedAir(Fixed, nn.Module):
    r"""A box in which the air is computed, by a lattice Boltzmann flow, instead of given by the wind.

    The wind of the simulation blows in through the faces of the box. The surface of the body stops the air as an
    immersed boundary (:mod:`~gaussian_swaying.air.immersed`), and gets the force that this takes. docs/air.md says what
    it is good for, and what not.

    Args:
        low: Lower corner of the box [m], from the object's centre, z up.
        high: Upper corner [m]. The last cells may reach beyond it.
        cells: Cells along its longest side.
        force: ``surface``: the body stops the air, for sheets that are larger than a few cells. ``law``: the law and
            the coefficients of ``aero`` act on every patch, in the air at it, and the air loses what it gives, for
            leaves and threads that are smaller than a cell.
        ground: Whether the lower face is the ground; otherwise the wind blows along it.
        walls: Regions in scene units in which there is no air, as around obstacles; they do not move.
        still_walls: Whether the Gaussians of the scene that stand still are walls, at least a cell thick.
        viscosity: Kinematic viscosity of the air [m²/s].
        smagorinsky: Constant of the subgrid model; 0 for none, which is for low Reynolds numbers.
        speed: Speed [m/s] that is a tenth of a cell per step; null for the largest of the wind without gusts, and half
            as much again. The larger it is, the smaller is the error of compressibility, and the more steps a frame
            takes.

    Raises:
        ValueError: If a number is out of range.
    """

    def __init__(
        self,
        low: Sequence[float],
        high: Sequence[float],
        cells: int = 48,
        *,
        force: Literal["surface", "law"] = "surface",
        ground: bool = False,
        walls: list[Region] = [],  # noqa: B006  (never changed)
        still_walls: bool = False,
        viscosity: float = 1.5e-5,
        smagorinsky: float = 0.1,
        speed: float | None = None,
    ) -> None:
        super().__init__()
        self.low, self.high = check_vector("low", low), check_vector("high", high)
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"Expected `low` of the air below `high` along each axis, but got {low} and {high}.")
        check_whole("air.cells", cells, LEAST_CELLS)
        check_positive("air.viscosity", viscosity)
        check_positive("air.smagorinsky", smagorinsky, allow_zero=True)
        if speed is not None:
            check_positive("air.speed", speed)
        self.cells, self.force, self.ground, self.walls = cells, force, bool(ground), list(walls)
        self.still_walls = bool(still_walls)
        self.viscosity, self.smagorinsky = float(viscosity), float(smagorinsky)
        self.speed = speed
        if math.prod(self.counts()) > MOST_CELLS:
            raise ValueError(f"`air.cells` of {cells:,} makes more than {MOST_CELLS:,} cells in all: lower it.")

    @property
    def spacing(self) -> float:
        """Side of a cell [m]."""
        return max(b - a for a, b in zip(self.low, self.high, strict=True)) / self.cells

    def counts(self) -> tuple[int, int, int]:
        sides = [math.ceil((b - a) / self.spacing - 1e-6) for a, b in zip(self.low, self.high, strict=True)]
        return sides[0], sides[1], sides[2] + self.ground


class AirPush(Force):
    r"""The force of computed air on the points in the substeps of a step of the air, :math:`\mathbf a - r \mathbf v`.

    It decreases with the velocity of the points, so that it damps whatever they do within the step.

    Args:
        points: Their number.
        like: A tensor of their type and device.

    Attributes:
        numbers: Force at rest [N] and its decrease per velocity [kg/s] of each point, shape (P, 4).
    """

    recordable = True
    numbers: Tensor

    def __init__(self, points: int, like: Tensor) -> None:
        super().__init__()
        with torch.inference_mode(False):  # recorded steps write it outside that mode
            numbers = torch.zeros(points, 4, dtype=like.dtype, device=like.device)
        self.register_buffer("numbers", numbers, persistent=False)

    def begin(self, at_rest: Tensor, rate: Tensor) -> None:
        """Start a step of the air, with a force at rest (P, 3) and its decrease per velocity (P,)."""
        self.numbers[:, :3] = at_rest
        self.numbers[:, 3] = rate

    def written(self) -> None:
        """Bump the version of ``numbers``, which a replayed graph changes without torch's knowledge."""
        torch.autograd.graph.increment_version(self.numbers)

    def taken(self, way: Tensor, faster: Tensor, substeps: int, dt: float) -> Tensor:
        """Momentum that the points took in some substeps [kg m/s], shape (P, 3).

        The sum of the velocities at which the force acted follows from the way of the points: symplectic Euler moves
        them by the velocity at the end of each substep.

        Args:
            way: How far the points moved [m], shape (P, 3).
            faster: By how much their velocity changed [m/s], shape (P, 3).
            dt: The substep [s].
        """
        way = way - dt * faster
        return substeps * dt * self.numbers[:, :3] - self.numbers[:, 3:] * way

    def device_function(self) -> DeviceFunction:
        return DeviceFunction(air_push, per_point=Numbers(4, lambda: self.numbers), sources=(self.numbers,))


@dataclass(frozen=True)
class Resolution:
    r"""Cost of a box, and the Reynolds number that it resolves.

    Attributes:
        cells: Cells along x, y and z.
        spacing: Side of a cell [m].
        steps: Steps of the air in a frame.
        megabytes: Memory of the air on the device [MB].
        reynolds: Reynolds number of the body: speed times longest side over viscosity.
        resolved: The same with the viscosity that the subgrid model has where the speed changes within a cell,
            :math:`\nu + C_s^2 h U`: eddies of larger Reynolds numbers are not resolved.
    """

    cells: tuple[int, int, int]
    spacing: float
    steps: int
    megabytes: float
    reynolds: float
    resolved: float

    def __str__(self) -> str:
        size = " x ".join(map(str, self.cells))
        return (
            f"computed air: {size} cells of {100 * self.spacing:.3g} cm, {self.steps} steps a frame, "
            f"{self.megabytes:.3g} MB; Reynolds number {self.reynolds:.2g}, resolved up to {self.resolved:.2g}"
        )


BYTES = 4 * 40 + 1 + 24
"""Bytes for a cell: four sets of moments (three on a CPU), its kind, and what points share among cells."""


def speed_of(settings: ComputedAir, wind: WindField) -> float:
    """The speed [m/s] that is :data:`LATTICE_SPEED`."""
    speed = settings.speed or 1.5 * float(torch.linalg.vector_norm(wind.flows.detach(), dim=-1).amax())
    if not speed > 0:
        raise ValueError("Computed air in a still wind needs `air.speed`: the largest speed that is expected [m/s].")
    return speed


def steps_of(settings: ComputedAir, wind: WindField, frame_dt: float) -> int:
    """Steps of the air in a frame of ``frame_dt`` seconds."""
    share = frame_dt * speed_of(settings, wind) / (LATTICE_SPEED * settings.spacing)
    return max(math.ceil(share - 1e-9), 1)


def resolution(settings: ComputedAir, wind: WindField, frame_dt: float, position: Tensor) -> Resolution:
    """Cost of a box, and the Reynolds number that it resolves.

    Args:
        position: Points of the body at rest [m], shape (P, 3).
    """
    speed, length = speed_of(settings, wind), float((position.amax(0) - position.amin(0)).amax())
    counts, h, nu = settings.counts(), settings.spacing, settings.viscosity
    eddies = settings.smagorinsky**2 * h * speed
    steps, megabytes = steps_of(settings, wind, frame_dt), math.prod(counts) * BYTES / 1e6
    return Resolution(counts, h, steps, megabytes, speed * length / nu, speed * length / (nu + eddies))


class AirInBox:
    """The computed air of a run: its flow, and the exchange of momentum with a body.

    Args:
        settings: The box.
        load: The wind on the patches of the body.
        solver: The solver, bound to its material.
        frame: From scene units to metres.
        frame_dt: Length of a frame [s].
        state: The state at rest.
        still: Distance from what stands still in the scene; air within half a cell of it is wall. None for none.

    Attributes:
        steps: Its steps in a frame.
        resolution: What it costs and resolves.

    Raises:
        ValueError: If the air cannot be right: too few cells, points too far apart or too light, a wind that has no
            place here.
    """

    def __init__(
        self,
        settings: ComputedAir,
        load: WindForce,
        solver: Solver,
        frame: SimFrame,
        frame_dt: float,
        state: State,
        still: DistanceGrid | None = None,
    ) -> None:
        self.settings, self.frame_dt = settings, frame_dt
        self.load, self._solver = load, solver
        device, density = state.position.device, load.aero.air_density
        if density == 0:
            raise ValueError("Computed air needs `aero.air_density` above 0.")
        wind = load.wind
        if not isinstance(wind, WindField):
            raise ValueError("Computed air takes its inflow from `wind`, a WindField: leave out the custom wind.")
        apart = [type(effect).__name__ for effect in wind.effects if isinstance(effect, (Shelter, Obstacle))]
        if apart:
            raise ValueError(
                f"Computed air makes wakes itself: remove {', '.join(apart)} from `wind.effects`, and put obstacles "
                "into `air.walls`."
            )
        h, cells = settings.spacing, settings.counts()
        self.steps = steps_of(settings, wind, frame_dt)
        units = LatticeUnits(h, frame_dt / self.steps, settings.viscosity, density)
        self.origin = torch.tensor(settings.low, dtype=torch.float64)
        if settings.ground:
            self.origin[2] -= h
        self._origin = self.origin.to(state.position)
        centres = self._centres(cells)

        def solid(place: Tensor) -> Tensor:
            inside = torch.zeros(place.shape[:-1], dtype=torch.bool)
            for region in settings.walls:
                inside |= region.contains(frame.point_to_scene(self.origin + h * place)).cpu()
            if still is not None:
                inside |= still.at(self.origin + h * place)[0] < 0.5 * h
            return inside

        faces: list[Face | tuple[Face, Face]] = ["open", "open", ("wall", "open") if settings.ground else "open"]
        walls = solid if settings.walls or still is not None else None
        self.flow = LatticeFlow(cells, units, faces=faces, walls=walls, smagorinsky=settings.smagorinsky).to(device)
        if not len(self.flow.held) or not bool((self.flow.kind == FLUID).any()):
            raise ValueError(
                "The walls leave no way for the wind through the box of air: make `air.walls` smaller (or set "
                "`air.still_walls` to false), or move `air.low` and `air.high` apart."
            )
        self._inflow = centres.reshape(-1, 3)[self.flow.held.long().cpu()].to(device)
        self.push = AirPush(state.position.shape[-2], state.position)
        self._pair: list[Tensor] = []  # on a GPU, where recorded steps go to and fro between them
        self._begins, self._ends = ([Replayed(), Replayed()] for _ in range(2))
        area, mass = load.area.reshape(-1), solver.points.mass
        self._area = (area / h**2).to(torch.float32)
        self._mass = (mass / units.cell_mass).to(torch.float32)
        self.resolution = resolution(settings, wind, frame_dt, state.position)
        self._check(state, area)

    def _centres(self, cells: tuple[int, int, int]) -> Tensor:
        axes = [torch.arange(n, dtype=torch.float64) + 0.5 for n in cells]
        return self.origin + self.settings.spacing * torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)

    def _check(self, state: State, area: Tensor) -> None:
        h, settings = self.settings.spacing, self.settings
        low, high = state.position.amin(0).tolist(), state.position.amax(0).tolist()
        box = settings.low, settings.high
        if not all(a + 2 * h <= x and y <= b - 2 * h for a, x, y, b in zip(box[0], low, high, box[1], strict=True)):
            held = f"from {_rounded(low)} to {_rounded(high)} m"
            raise ValueError(
                f"The body reaches {held} from its centre, within two cells of the faces of `air`: lower `air.low`, or "
                "raise `air.high`."
            )
        length = max(b - a for a, b in zip(low, high, strict=True))
        if length < LEAST_CELLS * h:
            raise ValueError(
                f"The body is {length / h:.1f} cells of air long, and with fewer than {LEAST_CELLS} no wake is "
                f"resolved: raise `air.cells` to {math.ceil(self.settings.cells * LEAST_CELLS * h / length)} or more."
            )
        if settings.force == "law":
            return
        widest = float(area.amax()) ** 0.5
        if widest > h:
            raise ValueError(
                f"The points of the surface are {widest:.3g} m apart and the cells of air {h:.3g} m wide: air would "
                f"pass between them. Lower `air.cells` to {int(self.settings.cells * h / widest)}, or give the surface "
                "more points (`solver.dx`)."
            )
        still = torch.zeros(MOMENTS, *self.flow.cells, device=self._area.device)
        _, layer = look(still, self._area, self._place(state.position), self.flow.kind)
        ratio = float(torch.where(layer > 0, self._mass / layer.clamp(min=1e-30), math.inf).amin())
        if ratio < LIGHTEST:
            raise ValueError(
                f"A point of the surface weighs {ratio:.2g} of the layer of air that it moves, and below {LIGHTEST} "
                "the force of the air is no longer right: raise `air.cells` or `material.density`."
            )

    def _place(self, position: Tensor) -> Tensor:
        """Positions [m] in cells from the centre of the first cell, float32."""
        return ((position.detach() - self._origin.to(position)) / self.settings.spacing - 0.5).float()

    def start(self, time: Tensor) -> Tensor:
        """The moments of air that moves as the wind does, shape (10, X, Y, Z)."""
        centres = self._centres(self.flow.cells).to(time.device)
        wind = self.load.air(time, centres.reshape(-1, 3)).expand(centres.numel() // 3, 3)
        velocity = wind.T.reshape(3, *self.flow.cells)
        return self.flow.start(velocity.float()).moments

    def velocity_at(self, moments: Tensor, place: Tensor) -> Tensor:
        """Velocity of the air at places [m/s], shape (..., 3); 0 in walls, and at the border outside of the box."""
        flat = place.reshape(-1, 3)
        low = self.origin.to(flat)
        high = low + self.settings.spacing * torch.tensor(self.flow.cells, device=flat.device)
        edge = 2 * self.settings.spacing
        inside = self._place(torch.minimum(torch.maximum(flat, low + edge), high - edge))
        found = values_at(moments[1:4], inside, self.flow.kind) * self.flow.units.speed
        return found.to(place).reshape(place.shape)

    def vorticity_at(self, moments: Tensor, place: Tensor) -> Tensor:
        """Vorticity of the air at places [1/s], shape (..., 3); 0 in walls and outside of the box."""
        field = self.flow.vorticity(FlowState(moments))
        return values_at(field, self._place(place.reshape(-1, 3)), self.flow.kind).to(place).reshape(place.shape)

    def take(self, load: WindForce) -> None:
        self.load = load

    @torch.no_grad()
    def roll(
        self,
        solver: Solver,
        state: Any,
        moments: Tensor,
        substeps: int,
        forces: Sequence[Force],
        looks: int,
        watch: Callable[[int], None] | None = None,
    ) -> tuple[Any, Tensor, Tensor]:
        """Advance the air and the body by a frame: in each step of the air the body moves, and then the air.

        Returns:
            The state of the body, the moments of the air, and the largest Courant number.
        """
        units, each = self.flow.units, -(-substeps // self.steps)
        dt, acting = units.dt / each, [self.push, *forces]
        begin, end = (self._wind(state.time + k * self.frame_dt) for k in (0, 1))
        self._check_speed(begin, end)
        pair = self._sets(moments)
        pair[0].copy_(moments)
        seen, marks = [], set(look_marks(self.steps, looks))
        for step in range(self.steps):
            now, spare = pair[step % 2], pair[1 - step % 2]
            key = (now.data_ptr(), spare.data_ptr(), each, dt)
            begun = partial(self._begin, now, each, dt)
            if self.settings.force == "surface":
                (place,) = self._begins[step % 2](key, begun, state.position, state.velocity)
                self.push.written()
            else:
                (place,) = begun(state.position, state.velocity, state)
            after, cfl = solver.watched_rollout(state, dt, each, acting, 1, None, check=False)
            if step + 1 in marks:
                seen.append(cfl)
            wind = torch.lerp(begin, end, (step + 1) / self.steps)
            way, faster = after.position - state.position, after.velocity - state.velocity
            self._ends[step % 2](key, partial(self._end, now, spare, each, dt), place, way, faster, wind)
            state = after
            if watch is not None:
                watch((step + 1) * each)
        self._check_inside(state)
        last = pair[self.steps % 2]
        return state, last.clone() if self._pair else last, torch.stack(seen).amax()

    def _sets(self, moments: Tensor) -> list[Tensor]:
        """On a GPU always the same tensors, as recordings keep their addresses."""
        if moments.is_cuda and not self._pair:
            with torch.inference_mode(False):
                self._pair = [torch.empty_like(moments) for _ in range(2)]
        return self._pair or [torch.empty_like(moments) for _ in range(2)]

    def _begin(
        self, moments: Tensor, substeps: int, dt: float, position: Tensor, velocity: Tensor, state: State | None = None
    ) -> list[Tensor]:
        """Begin a step: the force of the air in the substeps of the body. Returns the points in cells, shape (P, 3).

        The law needs the whole ``state``.
        """
        units, place = self.flow.units, self._place(position)
        air, layer = look(moments, self._area, place, self.flow.kind)
        air = (air * units.speed).to(velocity)
        rate = (together(self._mass, layer / substeps) * (units.cell_mass / dt)).to(velocity)
        self.push.begin(*((rate[:, None] * air, rate) if state is None else self._law(state, air, rate)))
        return [place]

    def _lose(self, moments: Tensor, substeps: int, dt: float, place: Tensor, way: Tensor, faster: Tensor) -> Tensor:
        """Take from the air what the body took in a step [kg m/s], shape (P, 3), which is returned."""
        taken = self.push.taken(way, faster, substeps, dt)
        units = self.flow.units
        give(moments, taken.float() / (units.cell_mass * units.speed), place, self.flow.kind)
        return taken

    def _end(self, now: Tensor, out: Tensor, substeps: int, dt: float, *given: Tensor) -> list[Tensor]:
        self._lose(now, substeps, dt, *given[:-1])
        self.flow.advance(now, out, given[-1])
        return []

    def _law(self, state: State, air: Tensor, most: Tensor) -> tuple[Tensor, Tensor]:
        """The force of the law at rest, and its decrease per velocity, which is at most ``most`` [kg/s]."""
        force, _ = self.load.force(state, air)
        relative = torch.linalg.vector_norm(air - state.velocity, dim=-1)
        size = torch.linalg.vector_norm(force, dim=-1)
        rate = torch.minimum(size / relative.clamp(min=1e-6), most)
        force = force * (rate * relative / size.clamp(min=1e-30)).clamp(max=1)[:, None]
        return force + rate[:, None] * state.velocity, rate

    def _wind(self, time: Tensor) -> Tensor:
        """The wind at the open faces [m/s], shape (H, 3)."""
        wind = self.load.air(time, self._inflow)
        return wind.to(self.flow.outward).expand(len(self._inflow), 3)

    def _check_speed(self, *winds: Tensor) -> None:
        fastest = max(float(torch.linalg.vector_norm(wind, dim=-1).amax()) for wind in winds)
        if not fastest <= FASTEST * self.flow.units.speed:
            raise ValueError(
                f"the wind of {fastest:.3g} m/s is too fast for the steps of the air, which are for up to "
                f"{FASTEST * self.flow.units.speed:.3g} m/s: raise `air.speed`"
            )

    def _check_inside(self, state: State) -> None:
        low = self.origin.to(state.position) + 1.5 * self.settings.spacing
        high = torch.tensor(self.settings.high).to(state.position) - 0.5 * self.settings.spacing
        out = ((state.position < low) | (state.position > high)).any()
        if bool(out):
            raise ValueError("the body has left the box of computed air: widen `air.low` and `air.high`")

    def momentum(self, moments: Tensor) -> Tensor:
        """Momentum of the air in the box [kg m/s], shape (3,), float64."""
        return self.flow.momentum(FlowState(moments))

    @property
    def walls(self) -> Tensor:
        """The wall cells, bool, shape (X, Y, Z)."""
        return self.flow.kind == WALL


def _rounded(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
