"""A simulation that runs in its own thread, and can be changed meanwhile."""

from __future__ import annotations

import copy
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from torch import Tensor

from gaussian_swaying._checks import one_line
from gaussian_swaying._inputs import spare_memory
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.device_functions import DeviceFunction
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.pull import pull
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.thinning import DETAIL
from gaussian_swaying.simulation.body import SimulatedScene, suggest_spacing
from gaussian_swaying.simulation.measure import FrameDiagnostics, SimulationDiverged
from gaussian_swaying.simulation.model import find, in_settings, number, of_settings
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.cost import estimate_cost
from gaussian_swaying.suggestion.suggest import QUALITIES, suggest

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

PICTURE = ("shader", "background")
"""Fields besides the numbers that change in motion."""

SHADER = "shader.init_args."


def changed_settings(parser: ArgumentParser, settings: Namespace, values: Mapping[str, Any]) -> Namespace:
    """Settings with other values. Parameters are set directly; other fields are parsed anew.

    Args:
        values: New values by the names of their fields, with dots, or of parameters.
    """
    numbers = {name: value for name, value in values.items() if find(name) is not None}
    shader = {name: value for name, value in values.items() if name.startswith(SHADER)}
    further = {name: value for name, value in values.items() if name not in numbers and name not in shader}
    if further:
        data = yaml.safe_load(parser.dump(settings, skip_validation=True))
        for name, value in further.items():
            *path, last = name.split(".")
            part = data
            for key in path:
                if not isinstance(part.get(key), dict):
                    part[key] = {}
                part = part[key]
            part[last] = value
        settings = parser.parse_object(data)
    else:
        settings = copy.deepcopy(settings)
    for name, value in shader.items():
        settings[name] = value
    in_settings(settings, numbers)
    return settings


def take(simulation: Simulation, parser: ArgumentParser, settings: Namespace, values: Mapping[str, Any]) -> bool:
    """Change a simulation between two steps.

    Parameters, the wind, aerodynamic coefficients, shading, background and length of a frame change in motion; the
    material only if it is the same everywhere.

    Returns:
        False if the simulation must be made anew.
    """
    numbers = {name: value for name, value in values.items() if find(name) is not None}
    heads = {name.split(".")[0] for name in values if name not in numbers}
    if not heads <= {"wind", "aero", *PICTURE}:
        return False
    if "frame_dt" in numbers and simulation.model.air is not None:
        return False  # computed air has one length of the frame
    if any(name.startswith("material.") for name in numbers) and (simulation.material.regions or settings.edits):
        return False  # each part has its own
    if not all(number(name).same_points for name in numbers):
        return False
    if settings.wind.schedule is not None or heads & {"wind", "aero"}:  # as a whole
        heads |= {name.split(".")[0] for name in numbers} & {"wind", "aero"}
        numbers = {name: value for name, value in numbers.items() if name.split(".")[0] not in heads}
    parts = parser.instantiate(settings) if heads else {}
    painter = simulation.painter
    if numbers:
        simulation.change(numbers)
    if "wind" in heads:
        simulation.wind = parts["wind"]
    if "aero" in heads:
        simulation.aero = parts["aero"]
    if "shader" in heads:
        painter.shader = None if parts["shader"] is None else parts["shader"].to(simulation.device)
    if "background" in heads:
        painter.background = torch.tensor(parts["background"], dtype=torch.float32, device=simulation.device)
    return True


REACH = 0.06  # radius of what is grabbed, as a share of the longest side


class Pull(Force):
    """Pulls some particles towards a place, with a spring and a damper that stops it from swinging.

    Args:
        share: Strength with which each particle is pulled, from 0 to 1, shape (P,).
        mass: Mass of each particle [kg], shape (P,).
        offset: From the mean of the pulled particles to each particle [m], shape (P, 3).
        target: Place to which their mean is pulled [m], shape (3,).
        frame: Transform between the scene and metres.
    """

    recordable = True
    held: Tensor
    offset: Tensor
    target: Tensor

    def __init__(self, share: Tensor, mass: Tensor, offset: Tensor, target: Tensor, frame: SimFrame) -> None:
        super().__init__()
        self.register_buffer("held", share * mass)
        self.register_buffer("offset", offset)
        self.register_buffer("target", target.clone())
        self._frame = frame

    @classmethod
    def at(cls, scene: SimulatedScene, state: State, place: Sequence[float]) -> Pull:
        """Make a pull on the particles around a place.

        Args:
            place: The place [scene units].
        """
        position, mass = state.position.detach(), scene.points.mass
        centre = scene.frame.point_to_sim(torch.tensor(list(place), dtype=torch.float64)).to(position)
        reach = REACH * scene.size * scene.frame.metres_per_unit
        distance = torch.linalg.vector_norm(position - centre, dim=-1)
        reach = max(reach, 1.5 * float(distance.amin()))
        share = torch.exp(-((2 * distance / reach) ** 2)).where(distance < reach, 0.0)
        held = share * mass
        mean = (held[:, None] * position).sum(0) / held.sum()
        return cls(share, mass, position - mean, mean, scene.frame)

    def aim(self, place: Sequence[float]) -> None:
        """Set the target [scene units]."""
        target = self._frame.point_to_sim(torch.tensor(list(place), dtype=torch.float64))
        self.target.copy_(target.to(self.target))

    def device_function(self) -> DeviceFunction:
        """The device function of :mod:`~gaussian_swaying.mpm.pull`."""
        return pull(
            lambda: torch.cat([self.offset, self.held[:, None]], -1),
            lambda time, dt, steps: self.target.expand(steps, 3),
            sources=(self.offset, self.held),
        )


SLOW, FAST = 0.09, 0.025  # s: steps that take longer are halved, and shorter ones doubled again
SHORTEST, FEW = 32, 4  # a step is at least this part of `frame_dt`; substeps of one that would take as long if shorter
WINDOW = 2.0  # s, over which rates are averaged
BEHIND = 0.25  # s that a session may be late before it stops trying to catch up
ONE_CHANGE = 1.0  # s: changes of the same fields that follow each other sooner are one, as when a slider is dragged
MOST_UNDONE = 50  # changes


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The simulation, its state and its measurements at one time.

    Attributes:
        health: Measurements at the end of the last step.
        number: Counts the snapshots of a session.
        motion: Counts the motions of a session: another one begins at rest.
    """

    simulation: Simulation
    state: State
    health: FrameDiagnostics
    number: int
    motion: int = 0


@dataclass
class Past:
    """The settings before a change, to undo it.

    Attributes:
        settings: The settings before it.
        names: The fields that it changed, with dots; None for all.
        time: When, on the clock of ``time.monotonic`` [s].
    """

    settings: Namespace
    names: list[str] | None
    time: float


SPARE = 1 << 26
"""Memory that a splat may take besides a multiple of its size [bytes]: less than elsewhere, as others may upload it."""


def settings_of_splat(
    parser: ArgumentParser,
    path: str | os.PathLike[str],
    device: torch.device,
    folder: Path,
    further: Sequence[str] = (),
    tell: Callable[[float, str], None] = lambda share, what: None,
    quick: bool = False,
) -> Namespace:
    """The settings that the preview suggests for a splat.

    Args:
        folder: Gets ``parts.npz``, which the settings name, if the splat has parts.
        tell: Called with the share that is done, from 0 to 1, and the name of the next task.
    """
    tell(0.05, "Reading the splat")
    with spare_memory(SPARE):
        gaussians = read_gaussians(path)
    tell(0.15, "Looking for a region, pins, a grid and how it sways")
    found = suggest(gaussians, quality="draft" if quick else "normal", device=device.type)
    found.to_yaml(folder / "starter.yaml", splat=Path(path))
    return parser.parse_args(["--config", str(folder / "starter.yaml"), "--device", device.type, *further])


def share_cores() -> None:
    """Limit threads started from now on to half of the cores: on a CPU one simulates and one draws."""
    torch.set_num_threads(max(1, torch.get_num_threads() // 2))


class Session:
    """Runs a simulation in a thread; every method may be called from any thread, and none waits for a step.

    A step is one frame of the configuration, or a part of it where the machine needs longer. If the simulation
    diverges, :attr:`problem` says so and the session waits for :meth:`reset`; if a value is not possible,
    :attr:`problem` says so and the session keeps the old one.

    Args:
        parser: From :meth:`Simulation.parser`.
        settings: Settings from it.
        simulation: The simulation of these settings, if it is made already.

    Attributes:
        settings: The settings as they are now; :meth:`yaml` writes them down.
        problem: One sentence on what went wrong last, or None.
        revision: Counts how often the settings became others than those asked for: by :meth:`undo`, :meth:`restore`,
            another scene, or a change that was refused.
        speed: Simulated seconds per second that are wanted; 1 is real time.
        configured_dx: Grid spacing of the configuration [m]; the session may begin with a coarser one.
        first_dx: Grid spacing with which it began [m].
        lock: Taken while the simulation is changed, and while it is drawn.
    """

    def __init__(self, parser: ArgumentParser, settings: Namespace, simulation: Simulation | None = None) -> None:
        self.parser, self.settings = parser, settings
        self.problem: str | None = None
        self.revision = 0
        self.speed, self.paused = 1.0, False
        self.lock = threading.RLock()
        self._wake = threading.Condition()
        self._asked: list[Callable[[], None]] = []
        self._changes: dict[str, Any] = {}
        self._single, self._closed, self._broken = False, False, False
        self._steps: deque[tuple[float, float]] = deque()  # when, and simulated time, of the last steps
        self._anchor: tuple[float, float] | None = None
        self._pull: Pull | None = None
        self._aim: Sequence[float] | None = None  # where it is to pull to
        self._number = self._motion = 0
        self._first = settings  # those that `restore` goes back to
        self.configured_dx = self.first_dx = float(settings.solver.dx)
        self._past: deque[Past] = deque(maxlen=MOST_UNDONE)
        self.simulation = _drawn_roughly(simulation or Simulation.from_settings(parser, settings))
        self._begin(self.simulation.start())
        self._thread = threading.Thread(target=self._loop, name="simulation", daemon=True)

    # ---- from any thread

    def start(self) -> Session:
        """Start the thread; returns the session."""
        self._thread.start()
        return self

    def close(self) -> None:
        """End the thread; returns when it has ended."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def change(self, values: Mapping[str, Any]) -> None:
        """Change fields of the configuration, for example ``{"wind.flow": [4, 0, 0], "material.E": 2e4}``.

        Some fields change in motion; for others the simulation is made anew, see :func:`take`.
        """
        with self._wake:
            self._changes.update(values)
            self._wake.notify_all()

    def load(
        self,
        settings: Namespace,
        done: Callable[[], None] = lambda: None,
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Go on with another scene, from rest.

        Args:
            done: Called in the thread of the session once the scene is there; not if it cannot be made.
        """

        def take_scene() -> None:
            try:
                self._take_settings(settings, fresh=True)
                self._first = settings
                self.configured_dx = self.first_dx = float(settings.solver.dx)
                self._past.clear()
                self.revision += 1
                done()
            finally:
                ended()

        self._ask(take_scene)

    def reset(self) -> None:
        self._ask(self._reset)

    def undo(self) -> None:
        """Undo the last change or :meth:`restore`. The motion goes on if the change did not stop it."""
        self._ask(self._undo)

    def restore(self) -> None:
        """Go back to rest, with the settings of the start or of the loaded scene."""
        self._ask(self._restore)

    @property
    def changes(self) -> int:
        return len(self._past)

    def reachable(self) -> list[Namespace]:
        """All settings that :meth:`undo` and :meth:`restore` can reach, and the current ones."""
        return [self.settings, self._first, *(past.settings for past in list(self._past))]

    def pause(self, paused: bool = True) -> None:
        with self._wake:
            self.paused = paused
            self._wake.notify_all()

    def step(self) -> None:
        with self._wake:
            self._single = True
            self._wake.notify_all()

    def grab(self, place: Sequence[float]) -> None:
        """Grab the material around a place; :meth:`drag` pulls it, until :meth:`let_go`.

        Args:
            place: Place in the scene now [scene units].
        """
        self._ask(lambda: self._grab(place))

    def drag(self, place: Sequence[float]) -> None:
        """Move the target of the grab [scene units]; before the next step the last call counts."""
        with self._wake:
            self._aim = place
            self._wake.notify_all()

    def let_go(self) -> None:
        self._ask(self._let_go)

    @property
    def pulls(self) -> bool:
        return self._pull is not None

    @property
    def broken(self) -> bool:
        """True if the simulation diverged, and waits for a reset."""
        return self._broken

    def wait(self, number: int, seconds: float) -> Snapshot:
        """The newest snapshot; waits up to some seconds for another one than number ``number``."""
        with self._wake:
            self._wake.wait_for(lambda: self.snapshot.number != number or self._closed, seconds)
        return self.snapshot

    def yaml(self) -> str:
        """The configuration as it is now; ``gaussian-swaying sim --config`` starts from it."""
        return config_text(self.parser, self.settings)

    def rate(self) -> float:
        steps, now = list(self._steps), time.perf_counter()
        steps = [step for step in steps if now - step[0] < WINDOW]
        if len(steps) < 2:
            return 0.0
        between = steps[-1][0] - steps[0][0]
        overdue = now - steps[-1][0] - between / (len(steps) - 1)  # a step that is under way is not late yet
        took = max(between + max(overdue, 0.0), 1e-6)
        return (steps[-1][1] - steps[0][1]) / took

    # ---- in the thread

    def _ask(self, what: Callable[[], None]) -> None:
        with self._wake:
            self._asked.append(what)
            self._wake.notify_all()

    def _loop(self) -> None:
        while True:
            with self._wake:
                while not (self._closed or self._busy() or self._single or self._runs()):
                    self._wake.wait()
                if self._closed:
                    return
                asked, self._asked = self._asked, []
                changes, self._changes = self._changes, {}
                aim, self._aim = self._aim, None
                single, self._single = self._single and not self._broken, False
            for what in asked:
                self._safely(what)
            if changes:
                self._safely(partial(self._change, changes))
            if aim is not None and self._pull is not None:
                self._safely(partial(self._pull.aim, aim))
            if single or self._runs():
                self._advance(single)

    def _busy(self) -> bool:
        return bool(self._asked or self._changes or self._aim is not None)

    def _runs(self) -> bool:
        return not self.paused and not self._broken

    def _safely(self, what: Callable[[], None]) -> None:
        """Call a function; if it fails because a request is not possible, keep the old settings and say why."""
        try:
            with self.lock:
                what()
        except Exception as error:
            self.problem = one_line(error)
            self.revision += 1

    def _advance(self, single: bool) -> None:
        simulation, began = self.simulation, time.perf_counter()
        try:
            with torch.inference_mode():
                state, health = simulation.advance(self.snapshot.state)
        except SimulationDiverged as error:
            self.problem, self._broken = str(error), True  # in this order, for those who look at it meanwhile
            return
        except Exception as error:  # out of memory, a kernel that fails: the page goes on
            self.problem, self._broken = one_line(error), True
            return
        if simulation.editor.edits:
            try:
                with self.lock:
                    state = simulation.editor.edit_due(state)
            except Exception as error:
                self.problem, self._broken = one_line(error), True
                return
        self._publish(state, health)
        took, wanted = time.perf_counter() - began, float(self.settings.frame_dt)
        shortest = wanted if simulation.model.air is not None else wanted / SHORTEST  # computed air has one length
        if took > SLOW and health.substeps > FEW and simulation.frame_dt > 1.01 * shortest:
            simulation.frame_dt = simulation.frame_dt / 2
        elif took < FAST and simulation.frame_dt < 0.99 * wanted:
            simulation.frame_dt = min(2 * simulation.frame_dt, wanted)
        self._steps.append((time.perf_counter(), health.time))
        while self._steps and self._steps[-1][0] - self._steps[0][0] > WINDOW:
            self._steps.popleft()
        if not single:
            self._pace(health.time)

    def _pace(self, simulated: float) -> None:
        now = time.perf_counter()
        anchor = self._anchor
        if anchor is None:
            self._anchor = anchor = (now, simulated)
        due = anchor[0] + (simulated - anchor[1]) / self.speed
        if due < now - BEHIND:
            self._anchor = (now, simulated)
        elif due > now:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._busy(), due - now)

    def pace(self, speed: float) -> None:
        with self._wake:
            self.speed, self._anchor = max(float(speed), 1e-3), None

    def _publish(self, state: State, health: FrameDiagnostics) -> None:
        self._number += 1
        self.snapshot = Snapshot(self.simulation, state, health, self._number, self._motion)
        with self._wake:
            self._wake.notify_all()

    def _begin(self, state: State) -> None:
        self._let_go()
        self._broken, self.problem, self._anchor = False, None, None
        self._steps.clear()
        self._motion += 1
        self._publish(state, self.simulation.stepper.at_first(state).read())

    def _reset(self) -> None:
        self._begin(self.simulation.start())

    def _change(self, values: Mapping[str, Any]) -> None:
        before, now = self.settings, time.monotonic()
        self._apply(changed_settings(self.parser, self.settings, values), values)
        last = self._past[-1] if self._past else None
        if last is not None and last.names == list(values) and now - last.time < ONE_CHANGE:
            last.time = now
        else:
            self._past.append(Past(before, list(values), now))

    def _apply(self, settings: Namespace, values: Mapping[str, Any]) -> None:
        if not self._broken:
            self.problem = None
        if take(self.simulation, self.parser, settings, values):
            self.settings = settings
            self._publish(self.snapshot.state, self.snapshot.health)
        else:
            self._take_settings(settings)

    def _undo(self) -> None:
        if not self._past:
            return
        past = self._past[-1]
        if past.names is None or self._broken:
            self._take_settings(past.settings, fresh=True)
        else:
            values = {name: of_settings(past.settings, name) if find(name) else None for name in past.names}
            self._apply(past.settings, values)
        self._past.pop()
        self.revision += 1

    def _restore(self) -> None:
        before = self.settings
        self._take_settings(self._first, fresh=True)
        self._past.append(Past(before, None, 0.0))
        self.revision += 1

    def _take_settings(self, settings: Namespace, fresh: bool = False) -> None:
        simulation = _drawn_roughly(Simulation.from_settings(self.parser, settings))
        start = simulation.start()
        state = None  # goes on only between solvers that can
        if not (self._broken or fresh):
            state = simulation.solver.continued(self.simulation.solver, self.snapshot.state, start)
        self.simulation, self.settings = simulation, settings
        if state is None:
            self._begin(start)
        else:
            self._let_go()
            self._publish(state, self.snapshot.health)

    def _grab(self, place: Sequence[float]) -> None:
        self._let_go()
        self._pull = Pull.at(self.simulation.scene, self.snapshot.state, place)
        self.simulation.custom_forces = (*self.simulation.custom_forces, self._pull)

    def _let_go(self) -> None:
        if self._pull is not None:
            forces = self.simulation.custom_forces
            self.simulation.custom_forces = tuple(force for force in forces if force is not self._pull)
            self._pull = None


def _drawn_roughly(simulation: Simulation) -> Simulation:
    simulation.painter.renderer = make_renderer(simulation.device, detail=DETAIL)
    return simulation


HEADROOM = 1.25  # x real time, so that the page can be drawn and the material stiffen
MARGIN = 1.2  # a grid is tried that should be so many times faster still: a trial is short, and its time not exact
TRIALS = 2  # of other grids than the configured one
CLOSE = 0.1  # another trial on a grid that is so close would tell nothing
BUDGET = 0.5  # s; for the frames of a trial
SURFACE = 3.0  # power of 1 / dx with which the time grows for a surface
MOTION = 2.0  # s of motion whose cost is estimated


@dataclass(frozen=True, eq=False)
class Choice:
    """A grid for the live page.

    Attributes:
        settings: The settings with it.
        sentence: What was chosen, and how to get the configured grid.
    """

    settings: Namespace
    simulation: Simulation
    sentence: str


def in_real_time(parser: ArgumentParser, settings: Namespace, simulation: Simulation) -> Choice:
    """Choose the finest grid, not finer than the configured one, on which this machine keeps up with real time."""
    configured = float(settings.solver.dx)
    made = {configured: (settings, simulation)}
    frames = 1 + max(1, round(MOTION / simulation.frame_dt))

    def cost(dx: float) -> float:
        if dx not in made:
            changed = changed_settings(parser, settings, {"solver.dx": dx})
            made[dx] = changed, Simulation.from_settings(parser, changed)
        found = estimate_cost(made[dx][1], frames, budget=BUDGET, pictures=False)
        return found.total_seconds - found.startup_seconds

    seconds, scene = (frames - 1) * simulation.frame_dt, simulation.scene
    coarsest = suggest_spacing(scene.size * scene.frame.metres_per_unit, 0.0, QUALITIES["draft"])
    dx, tried = finest_within(cost, seconds / HEADROOM, configured, coarsest)
    return Choice(*made[dx], sentence(configured, dx, seconds / tried[configured], seconds / tried[dx]))


def finest_within(
    cost: Callable[[float], float], wish: float, configured: float, coarsest: float = math.inf
) -> tuple[float, dict[float, float]]:
    """The finest trial grid whose cost is within a limit, or else the cheapest one; with all costs.

    Args:
        cost: Cost for a grid spacing [m]; ValueError where the grid is too coarse for the scene, such as for a pin.
        configured: Smallest grid spacing [m]; its errors are raised.
        coarsest: Largest grid spacing [m]; if it is less than ``configured``, that one is kept.
    """
    tried = {configured: cost(configured)}
    if tried[configured] <= wish or configured >= coarsest:
        return configured, tried
    for _ in range(TRIALS):
        dx = _predicted(tried, wish / MARGIN, configured, coarsest)
        if any(dx == known or (took <= wish and abs(dx / known - 1) < CLOSE) for known, took in tried.items()):
            break
        try:
            tried[dx] = cost(dx)
        except ValueError:
            coarsest = math.sqrt(configured * dx)
    within = [dx for dx, took in tried.items() if took <= wish]
    return (min(within) if within else min(tried, key=lambda dx: tried[dx])), tried


def _predicted(tried: Mapping[float, float], wish: float, finest: float, coarsest: float) -> float:
    """The finest grid spacing whose cost should be at most a wish [m], rounded up to two digits.

    The cost grows with a power of 1 / dx: that between the two grids nearest to the wish, or the third of a surface.
    """
    near, *others = sorted(tried, key=lambda dx: abs(math.log(tried[dx] / wish)))
    power = SURFACE
    if others and abs(math.log(others[0] / near)) > CLOSE:
        power = math.log(tried[others[0]] / tried[near]) / math.log(near / others[0])
    dx = near * (tried[near] / wish) ** (1 / min(max(power, 1.0), 4.0))
    unit = 10.0 ** (math.floor(math.log10(dx)) - 1)
    return min(max(float(f"{math.ceil(dx / unit - 1e-6) * unit:.2g}"), finest), coarsest)


def sentence(configured: float, chosen: float, configured_speed: float, speed: float) -> str:
    """A sentence that names the chosen grid, and how to get the configured one.

    Args:
        configured: Its spacing [m].
        chosen: Spacing of the grid that was chosen [m].
    """
    fast = f"predicted to run at {speed:.2g} x real time here"
    if chosen == configured:
        kept = f"The configured grid of {configured:g} m is kept, {fast}"
        return f"{kept}." if speed >= 1 else f"{kept}; no coarser one that shows the object was found."
    why = "" if speed >= 1 else ", the fastest one found"
    return (
        f"Chose a grid of {chosen:g} m{why}, {fast}, instead of the configured {configured:g} m "
        f"({configured_speed:.2g} x): --grid configured, or Grid on the page, takes that one."
    )
