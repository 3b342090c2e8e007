"""Measurements of a frame, the health of a run, and its progress."""

from __future__ import annotations

import copy
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.linalg import determinant, largest_eigenvalue, matmul3
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.kernels.graphs import RECORDED, Replayed
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import State, support_force
from gaussian_swaying.wind.force import AirLift

_PARTICLES = ("moved_particle", "compressed_particle", "stretched_particle")
_SAMPLE = 4096  # particles whose nearest neighbour is searched


class SimulationDiverged(RuntimeError):  # noqa: N818  (it ends a run the way StopIteration ends a loop)
    """The simulation diverged: a value is NaN, infinite or absurdly large.

    Attributes:
        time: Simulated time [s].
        particle: Index of the first bad particle, or None if no single one is to blame.
        cause: The cause, in words.
        remedy: The remedy, in words.
    """

    def __init__(self, time: float, particle: int | None, cause: str, remedy: str) -> None:
        self.time, self.particle, self.cause, self.remedy = time, particle, cause, remedy
        who = "" if particle is None else f", particle {particle}"
        super().__init__(f"The simulation diverged at t = {time:.4g} s{who}: {cause}. Remedy: {remedy}.")


@fixed
@dataclass(frozen=True)
class FrameDiagnostics:
    """Health of the state at the end of a frame; of a batch sums and extremes over its scenes.

    Attributes:
        time: Simulated time [s].
        substeps: Substeps of the frame.
        cfl: Largest Courant number of the frame.
        kinetic: Kinetic energy [J], with that of carried air (``aero.added_mass``), as the momenta.
        elastic: Elastic energy [J].
        potential: Potential energy of gravity [J], of the material alone.
        wind_work: Work of the wind on the material during the frame [J].
        momentum_x: Linear momentum [kg m/s].
        momentum_y: Linear momentum [kg m/s].
        momentum_z: Linear momentum [kg m/s].
        angular_momentum_x: Angular momentum about the origin [kg m²/s].
        angular_momentum_y: Angular momentum about the origin [kg m²/s].
        angular_momentum_z: Angular momentum about the origin [kg m²/s].
        lost: Particles that left the grid.
        torn: Elastic particles with a rest neighbour that is now more than two cells away, so that the grid no longer
            connects them; only in ``updated``.
        J_min: Smallest determinant of F.
        J_max: Largest determinant of F.
        stretch_min: Smallest singular value of F.
        stretch_max: Largest singular value of F.
        displacement_mean: Mean distance from rest [m].
        displacement_max: Largest distance from rest [m].
        moved_particle: Index of the particle that is farthest from rest.
        compressed_particle: Index of the particle with the smallest stretch.
        stretched_particle: Index of the particle with the largest stretch.
        support: Mean force of the body on each boundary during the frame [N], in the order of ``solver.boundaries``:
            for a pin the force on its support.
    """

    time: float
    substeps: int
    cfl: float
    kinetic: float
    elastic: float
    potential: float
    wind_work: float
    momentum_x: float
    momentum_y: float
    momentum_z: float
    angular_momentum_x: float
    angular_momentum_y: float
    angular_momentum_z: float
    lost: int
    torn: int
    J_min: float
    J_max: float
    stretch_min: float
    stretch_max: float
    displacement_mean: float
    displacement_max: float
    moved_particle: int
    compressed_particle: int
    stretched_particle: int
    support: tuple[tuple[float, float, float], ...] = ()

    def as_dict(self) -> dict[str, float | int]:
        """The fields by name, with ``support`` as three numbers for each boundary, ``support_0_x`` and so on."""
        values = asdict(self)
        forces = values.pop("support")
        return values | {
            f"support_{k}_{axis}": x for k, force in enumerate(forces) for axis, x in zip("xyz", force, strict=True)
        }


class TearingGauge:
    """Counts the particles that a sheet has numerically torn apart.

    In the ``updated`` formulation, two particles interact through shared grid nodes. Neighbours that drift more than
    two cells apart share no node, so the sheet between them is torn although no material law broke it.

    Args:
        solver: A solver with its material; particles with plastic laws may flow apart and are not counted.
        count: Number of neighbours watched for each particle, among those within two cells at rest.
    """

    def __init__(self, solver: Solver, count: int = 4) -> None:
        position = solver.points.position.detach()
        flat = position.reshape(-1, *position.shape[-2:])
        self.reach = 2 * solver.dx
        own = torch.arange(position.shape[-2], device=position.device)[:, None]
        count = min(count, position.shape[-2] - 1)
        self.neighbour = own.expand(len(flat), -1, 1)
        if count > 0:
            found = [nearest_neighbours(scene, count) for scene in flat]
            distance, index = (torch.stack(values).to(position.device) for values in zip(*found, strict=True))
            self.neighbour = torch.where(distance <= self.reach, index, own)
        scene = torch.arange(len(flat), device=position.device)[:, None, None]
        self.neighbour = (self.neighbour + position.shape[-2] * scene).reshape(-1)  # over the particles of all scenes
        self.elastic = solver.points.elastic

    def __call__(self, position: Tensor) -> Tensor:
        """Return a mask (scenes, P) of the particles torn from a neighbour, from positions (..., P, 3) [m]."""
        flat = position.reshape(-1, *position.shape[-2:])
        near = flat.reshape(-1, 3).index_select(0, self.neighbour).reshape(*flat.shape[:2], -1, 3)
        apart = torch.linalg.vector_norm(near - flat[:, :, None], dim=-1)
        torn = (apart > self.reach).any(-1)
        return torn if self.elastic is None else torn & self.elastic.reshape(torn.shape)


def check_spacing(solver: Solver) -> None:
    """Raise ValueError if most particles are isolated on the grid, so that no law could keep them together."""
    position = solver.points.position.detach().reshape(-1, *solver.points.position.shape[-2:])[0]
    if len(position) < 16:  # a few may be isolated on purpose
        return
    some = position[:: math.ceil(len(position) / _SAMPLE)]
    spacing = float(nearest_neighbours(position, 2, some)[0][:, 1].median())  # the first is the particle itself
    if spacing > 2 * solver.dx:
        raise ValueError(
            f"Half of the particles are more than {spacing:.3g} m from their nearest neighbour, more than two cells of "
            f"`solver.dx` = {solver.dx:g} m, so the grid does not connect them: raise `solver.dx` to about "
            f"{spacing:.2g} m."
        )


class Measurement:
    """Results of :func:`measure` on the device, which the host has not waited for yet."""

    def __init__(self, solver: Solver, substeps: int, scenes: int, parts: dict[str, Tensor]) -> None:
        self._solver, self._substeps, self._scenes = solver, substeps, scenes
        self._sizes = {name: len(part) for name, part in parts.items()}
        self.values = torch.cat(list(parts.values()))
        self._found: dict[str, list[Any]] = {}

    def again(self, substeps: int, values: Tensor) -> Measurement:
        """A copy for another frame, with new ``values`` in the same order."""
        new = copy.copy(self)
        new._substeps, new.values, new._found = substeps, values, {}
        return new

    def _wait(self) -> dict[str, list[Any]]:
        if not self._found:
            values = iter(self.values.tolist())
            self._found = {name: [next(values) for _ in range(size)] for name, size in self._sizes.items()}
        return self._found

    @property
    def cfl(self) -> float:
        return float(self._wait()["cfl"][0])

    @property
    def outran(self) -> bool:
        """True if a particle with a finite position left the grid in the frame."""
        return bool(self._wait()["outran"][0])

    @property
    def more(self) -> list[float]:
        """Further numbers that :func:`measure` was given."""
        return self._wait()["more"]

    def read(self, check: bool = False) -> FrameDiagnostics:
        """Wait for the measurements (one GPU synchronisation); the scenes of a batch are read as one scene.

        Args:
            check: Raise SimulationDiverged if a particle is NaN, infinite, outside the grid or extremely far away.
        """
        found = self._wait()
        if check:
            _raise_if_bad(self._solver, found["verdict"], found["time"][0])
        return self._scene(0) if self._scenes == 1 else _joined([self._scene(k) for k in range(self._scenes)])

    def each(self) -> tuple[FrameDiagnostics, ...]:
        self._wait()
        return tuple(self._scene(k) for k in range(self._scenes))

    def _scene(self, scene: int) -> FrameDiagnostics:
        found = self._found
        row = found["each"][scene :: self._scenes]
        own: dict[str, Any] = dict(zip(_OF_SCENE, row[: len(_OF_SCENE)], strict=True))
        own |= {name: int(own[name]) for name in ("lost", "torn", *_PARTICLES)}
        own["support"] = tuple(zip(*[iter(row[len(_OF_SCENE) :])] * 3, strict=True))
        return FrameDiagnostics(time=found["time"][0], substeps=self._substeps, cfl=self.cfl, **own)


_OF_SCENE = tuple(
    name for name in FrameDiagnostics.__dataclass_fields__ if name not in ("time", "substeps", "cfl", "support")
)
_EXTREMES: dict[str, Callable[..., Any]] = {"J_min": min, "J_max": max, "stretch_min": min, "stretch_max": max}

_EXTREMES |= {"displacement_max": max, "displacement_mean": lambda values: sum(values) / len(values)}

_WHOSE = dict(zip(_PARTICLES, ("displacement_max", "stretch_min", "stretch_max"), strict=True))


def _joined(scenes: Sequence[FrameDiagnostics]) -> FrameDiagnostics:
    first, found = scenes[0], {}
    for name in _OF_SCENE:
        values = [getattr(scene, name) for scene in scenes]
        if name in _PARTICLES:
            own = [getattr(scene, _WHOSE[name]) for scene in scenes]
            found[name] = values[own.index(_EXTREMES[_WHOSE[name]](own))]
        else:
            found[name] = _EXTREMES.get(name, sum)(values)
    forces = zip(*(scene.support for scene in scenes), strict=True)
    found["support"] = tuple((sum(f[0] for f in of), sum(f[1] for f in of), sum(f[2] for f in of)) for of in forces)
    return replace(first, **found)


@torch.no_grad()
def measure(
    solver: Solver,
    state: State,
    substeps: int,
    cfl: Tensor | float,
    tearing: TearingGauge | None = None,
    before: State | None = None,
    more: Tensor | None = None,
    lift: AirLift | None = None,
) -> Measurement:
    """Measure the health of a state, without waiting for the device.

    Args:
        state: The state at the end of the frame, of one scene or of a batch of shape (B,).
        before: The state at the start of the frame, for the work of the wind and the forces on supports; they are zero
            without it.
        more: Further numbers to read with them, float64, shape (n,).
    """
    start = state if before is None else before
    moved = torch.linalg.vector_norm(state.position - solver.points.position, dim=-1)
    energies, momenta = solver.energies(state), solver.momenta(state)
    work = state.work - start.work
    if lift is not None:
        lifted = lift.potential(state)
        energies["potential"] = energies["potential"] + lifted.to(energies["potential"])
        work = work + (lifted - lift.potential(start)).to(work.device)
    J = determinant(state.F_total)
    F = in_double(state.F_total)
    C = matmul3(F.mT, F)
    longest, shortest = largest_eigenvalue(torch.stack([C, -C])).abs().sqrt().unbind()
    columns = {
        **energies,
        "wind_work": work,
        **{f"momentum_{axis}": momenta["linear"][..., k] for k, axis in enumerate("xyz")},
        **{f"angular_momentum_{axis}": momenta["angular"][..., k] for k, axis in enumerate("xyz")},
        "lost": state.lost.sum(-1),
        "torn": torch.zeros_like(moved[..., 0]) if tearing is None else tearing(state.position).sum(-1),
        "J_min": J.amin(-1),
        "J_max": J.amax(-1),
        "stretch_min": shortest.amin(-1),
        "stretch_max": longest.amax(-1),
        "displacement_mean": moved.mean(-1),
        "displacement_max": moved.amax(-1),
        "moved_particle": moved.argmax(-1),
        "compressed_particle": shortest.argmin(-1),
        "stretched_particle": longest.argmax(-1),
    }
    scenes = moved.shape[:-1].numel()
    support = support_force(start, state)
    support = in_double(support).reshape(scenes, 3 * support.shape[-2])
    each = [in_double(columns[name]).reshape(-1) for name in _OF_SCENE]
    courant = cfl if isinstance(cfl, Tensor) else torch.full_like(state.time, cfl)
    parts = {
        "time": state.time[None],
        "cfl": courant.to(state.time).reshape(1),
        "each": torch.cat([*each, support.mT.reshape(-1)]),
        "verdict": _verdict(solver, state, moved),
        "outran": _outran(start, state),
        "more": state.time[None][:0] if more is None else more,
    }
    return Measurement(solver, substeps, scenes, parts)


class Gauge:
    """:func:`measure` from a CUDA graph, where possible: some 150 small kernels take longer to start than to run.

    That is on a GPU, for a solver whose grid does not move, and at most ``RECORDED`` particles, as a graph
    keeps its memory.
    """

    def __init__(self) -> None:
        self.replayed = Replayed()
        self._made: Measurement | None = None

    @torch.no_grad()
    def __call__(
        self,
        solver: Solver,
        state: State,
        substeps: int,
        cfl: Tensor,
        before: State,
        more: Callable[[State], Tensor],
        same: tuple[object, ...] | None,
        lift: AirLift | None = None,
    ) -> Measurement:
        """As :func:`measure`, without counting torn particles.

        Args:
            same: Key of all else that ``more`` depends on; another key makes another recording. None to record nothing.
            lift: As in :func:`measure`; it changes only with ``same``.
        """
        small = state.position.is_cuda and state.position.shape[:-1].numel() <= RECORDED
        fixed = solver.neighbours_fixed and state.F_elastic is state.F_total
        if not (small and fixed) or same is None:
            return measure(solver, state, substeps, cfl, None, before, more(state), lift)

        names = [name for name, value in state.fields().items() if isinstance(value, Tensor) and name not in _UNREAD]
        first = ["work", "impulse", "time"] if lift is None else ["work", "impulse", "time", "position"]

        def values(its_cfl: Tensor, *fields: Tensor) -> list[Tensor]:
            found = dict(zip(names, fields[len(first) :], strict=True))
            end = state.replace(**found, F_elastic=found["F_total"])
            start = end.replace(**dict(zip(first, fields[: len(first)], strict=True)))
            self._made = measure(solver, end, substeps, its_cfl, None, start, more(end), lift)
            return [self._made.values]

        given = [*(getattr(before, name) for name in first), *(getattr(state, name) for name in names)]
        key = (solver, *same)
        (found,) = self.replayed(key, values, cfl, *given)
        assert self._made is not None
        return self._made.again(substeps, found)


_UNREAD = ("F_elastic", "affine")
"""Fields of a state that a recording of :func:`measure` does not read; ``F_elastic`` is the same as ``F_total``."""


def _outran(before: State, after: State) -> Tensor:
    """Return 1 if a particle with a finite position left the grid between two states, else 0; float64, shape (1,)."""
    new = after.lost & ~before.lost & torch.isfinite(after.position).all(-1)
    return in_double(new.any()).reshape(1)


FARTHEST = 1000  # a run ends when a particle is so many sizes of the object away from where it started
_FAR, _LOST, _NOT_FINITE = 1, 2, 3  # what is wrong with a particle; the last is the worst


def _verdict(solver: Solver, state: State, moved: Tensor) -> Tensor:
    """Problem of the first bad particle (0 for none), its index, number of lost particles, size of the object [m].

    ``moved`` is how far each particle is from rest [m], shape (..., P). Four float64 values.
    """
    low, high = torch.aminmax(solver.points.position.reshape(-1, 3), dim=0)
    size = (high - low).amax().clamp(min=solver.dx)
    values = torch.cat([state.position, state.velocity, state.F_elastic.flatten(-2)], dim=-1)
    finite = values.abs().amax(-1) < math.inf  # not for NaN either
    wrong = torch.where(state.lost, _LOST, (moved > FARTHEST * size).int())
    wrong = torch.where(finite, wrong, _NOT_FINITE).reshape(-1)
    first = (wrong > 0).int().argmax(0, keepdim=True)
    found = torch.cat([wrong.index_select(0, first), first, state.lost.sum()[None]])
    return torch.cat([in_double(found), in_double(size[None])])


def _raise_if_bad(solver: Solver, verdict: list[float], time: float) -> None:
    wrong, particle, lost = (int(value) for value in verdict[:3])
    if wrong == 0:
        return
    if wrong == _NOT_FINITE:
        cause = "its position, velocity or deformation is NaN or infinite"
        remedy = (
            "lower `solver.cfl`"
            if solver.substep is None
            else f"lower `solver.substep` (stable at rest: {solver.stable_substep():.3g} s) or set it to null"
        ) + ", or check the wind and the boundary velocities"
    elif wrong == _LOST:
        cause = f"it left the grid ({lost} particles did)"
        remedy = "enclose the scene with a Wall, or lower the speeds that carry it away"
    else:
        cause = f"it is more than {FARTHEST} object sizes ({verdict[3]:.3g} m) away from where it started"
        remedy = "pin or enclose the object, or lower `solver.cfl`"
    raise SimulationDiverged(time, particle, cause, remedy)


SOUND = (0.5, 2.0)  # range of stretch within which the object keeps its intended shape
USUAL = 0.2  # largest displacement, as a fraction of the size, that still looks like wind


def extremes(log: Sequence[Mapping[str, Any]], where: Tensor, size: float, elastic: Tensor | None) -> dict[str, Any]:
    """Return the largest displacement, compression and stretch over the frames of a run.

    Args:
        where: Rest positions of the particles [scene units], shape (P, 3).
        size: Longest side of the object [m].
        elastic: Which particles are elastic, shape (P,), None for all; the stretch of plastic materials means nothing.

    Returns:
        ``moved``, ``compressed`` and ``stretched``, each a dictionary with ``value`` (in m or as a ratio of lengths),
        ``at`` (rest position, scene units) and ``time`` [s]; ``moved`` also has its ``share`` of the size. None where
        no frame has a value.
    """
    found: dict[str, Any] = {}
    for name, field, particle, sign in (
        ("moved", "displacement_max", "moved_particle", 1),
        ("compressed", "stretch_min", "compressed_particle", -1),
        ("stretched", "stretch_max", "stretched_particle", 1),
    ):
        told = [entry for entry in log if entry[particle] < len(where)]
        if elastic is not None and name != "moved":
            told = [entry for entry in told if bool(elastic.reshape(-1)[entry[particle]])]
        if not told:
            found[name] = None
            continue
        worst = max(told, key=lambda entry: sign * entry[field])
        place = [round(float(v), 4) for v in where[worst[particle]]]
        found[name] = {"value": worst[field], "at": place, "time": worst["time"]}
    if found["moved"] is not None:
        found["moved"]["share"] = found["moved"]["value"] / size
    return found


def advice(found: Mapping[str, Any], E: float, thickness_matters: bool = True, pins: bool = True) -> list[str]:
    """Sentences on what went wrong with the shape of the object and what to change; none if all is well.

    Args:
        E: Largest Young's modulus of the run [Pa].
        pins: Whether ``solver.boundaries`` has any.
    """
    low, high = SOUND
    small, large, moved = found["compressed"], found["stretched"], found["moved"]
    bad, factor = [], 1.0
    if small is not None and not small["value"] >= low:
        bad.append(f"compressed to {_digits(small['value'])} of its length {_place(small)}")
        factor = max(factor, (1 - max(small["value"], 0.0)) / (1 - low))
    if large is not None and not large["value"] <= high:
        bad.append(f"stretched to {_digits(large['value'])} times its length {_place(large)}")
        factor = max(factor, (large["value"] - 1) / (high - 1))
    if not bad:
        return []
    said = [f"The material was {' and '.join(bad)}; between {low:g} and {high:g} it keeps its shape."]
    if moved is not None:
        said.append(f"The largest displacement was {_digits(moved['value'])} m, {moved['share']:.0%} of the size, "
                    f"{_place(moved)}.")  # fmt: skip
    share = 0.0 if moved is None else moved["share"]
    factor = min(max(2 * factor, share / USUAL, 3.0), 10.0)
    stiffer = f"raise `material.E` to about {E * factor:.0e} Pa"
    if thickness_matters:
        stiffer += f" or `material.thickness` to {factor:.0f} times"
    enlarge = "; or enlarge the `region` of the pins in `solver.boundaries`, if parts move that should stay in place"
    said.append(f"What to change: {stiffer}; or weaken `wind.flow`{enlarge if pins else ''}.")
    return said


def _place(entry: Mapping[str, Any]) -> str:
    at = ", ".join(f"{value:.3g}" for value in entry["at"])
    return f"at [{at}] (scene units, at rest) after {entry['time']:.3g} s"


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


LONG_FRAME = 60.0  # s; a first frame that takes longer is reported
MANY_TIMES = 20  # a frame with this many times the substeps of the first is reported
PAUSE = 1.0  # s between two updates within a frame


class RunProgress:
    """A progress bar of frames that also shows the progress within a slow frame, and reports why it is slow.

    Args:
        frames: Frames of the whole run.
        done: Frames that are already done.
        shown: Whether to show anything.
    """

    def __init__(self, frames: int, done: int = 0, shown: bool = True) -> None:
        self.shown = shown
        self._bar = tqdm(total=frames, initial=min(done, frames), unit="frame", disable=not shown, file=sys.stderr)
        self._frames, self._frame = frames, done
        self._usual: int | None = None  # substeps of the first frame that was simulated
        self._told = 0  # substeps of the frame that was last reported
        self._steps = self._first = self._last = 0
        self._began = self._looked = time.perf_counter()

    def begin(self, frame: int) -> None:
        self._frame, self._steps = frame, 0

    def substep(self, done: int, steps: int) -> None:
        now = time.perf_counter()
        if steps != self._steps or done <= self._last:  # a new frame, or the same again with shorter substeps
            self._began = self._looked = now
            self._steps, self._first = steps, done
        self._last = done
        if now - self._looked < PAUSE:
            return
        self._looked = now
        each = (now - self._began) / (done - self._first)
        self._bar.set_postfix_str(
            f"substep {done:,} of {steps:,}, {duration(each * (steps - done))} left in this frame"
        )
        self._tell(steps, each * steps)

    def _tell(self, steps: int, whole: float) -> None:
        many = self._usual is not None and steps > MANY_TIMES * self._usual
        if not self.shown or steps < 4 * self._told or not (many or (self._usual is None and whole > LONG_FRAME)):
            return
        self._told = steps
        text = f"Frame {self._frame} takes {steps:,} substeps, about {duration(whole)}"
        if many and self._usual is not None:
            text += (
                f", {steps // self._usual:,} times those of the first: something stiffened or moves fast. Weaken the "
            )
            text += "wind or other driving forces, or raise `solver.damping`."
        else:
            rest = duration(whole * max(self._frames - self._frame, 1))
            text += f", and the remaining frames about {rest}. For fewer substeps: a lower `material.E`, a higher "
            text += "`material.density`, a coarser `solver.dx`, a longer `solver.substep`."
        tqdm.write(f"note: {text}", file=sys.stderr)

    def end(self, substeps: int, moved: float) -> None:
        """Note that a frame is done.

        Args:
            moved: Mean distance of the particles from where they were at rest [m].
        """
        if self._usual is None and substeps > 0:
            self._usual = substeps
        self._bar.update()
        self._bar.set_postfix_str(f"{substeps:,} substeps, {moved:.3f} m from rest on average")

    def close(self) -> None:
        self._bar.close()


def duration(seconds: float) -> str:
    """A duration in a readable form: 12 ms, 3.4 s, 5 min, 2.1 h, 3 days.

    Example:
        >>> [duration(seconds) for seconds in (0.012, 3.4, 300, 7560, 3 * 86400)]
        ['12 ms', '3.4 s', '5 min', '2.1 h', '3 days']
    """
    if not math.isfinite(seconds):
        return "unknown"
    for unit, size, limit in (("ms", 1e-3, 1.0), ("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172800.0)):
        if seconds < limit:
            return f"{seconds / size:.2g} {unit}" if seconds / size < 10 else f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:,.0f} days"
