"""A simulation that runs in its own thread, and can be changed meanwhile."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from gaussian_swaying._checks import one_line
from gaussian_swaying.config.parser import config_text
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.thinning import DETAIL
from gaussian_swaying.simulation.measure import FrameDiagnostics, SimulationDiverged
from gaussian_swaying.simulation.model import find, of_settings
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.changes import changed_settings, take
from gaussian_swaying.viewer.pull import Pull

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

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
        simulation: The simulation.
        state: Its state.
        health: Measurements at the end of the last step.
        number: Counts the snapshots of a session.
        motion: Counts the motions of a session: another one begins at rest.
    """

    simulation: Simulation
    state: State
    health: FrameDiagnostics
    number: int
    motion: int = 0


@dataclass(frozen=True)
class Rates:
    """The speed of a session.

    Attributes:
        steps: Steps per second.
        real_time: Simulated seconds per second.
        step: Length of a step [s].
        substeps: Substeps of the last step.
    """

    steps: float
    real_time: float
    step: float
    substeps: int


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


def share_cores() -> None:
    """Give threads that start from now on half of the cores: one simulates and one draws, on a CPU."""
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
        self._number = self._motion = 0
        self._first = settings  # those that `restore` goes back to
        self.configured_dx = float(settings.solver.dx)
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

        Some fields change in motion; for others the simulation is made anew, see :func:`.changes.take`.
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
            settings: Its settings.
            done: Called in the thread of the session once the scene is there; not if it cannot be made.
            ended: Called there in both cases.
        """

        def take_scene() -> None:
            try:
                self._take_settings(settings, fresh=True)
                self._first = settings
                self.configured_dx = float(settings.solver.dx)
                self._past.clear()
                self.revision += 1
                done()
            finally:
                ended()

        self._ask(take_scene)

    def reset(self) -> None:
        self._ask(self._reset)

    def undo(self) -> None:
        """Take the last change back, or :meth:`restore`; the motion goes on if it did with the change."""
        self._ask(self._undo)

    def restore(self) -> None:
        """Go back to rest and to the settings of the start, or of the scene that was loaded: pins, material, all."""
        self._ask(self._restore)

    @property
    def changes(self) -> int:
        return len(self._past)

    def reachable(self) -> list[Namespace]:
        """The settings now, and all to which :meth:`undo` and :meth:`restore` can go back."""
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
        """Pull the grabbed material towards a place [scene units]."""
        self._ask(lambda: None if self._pull is None else self._pull.aim(place))

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

    def rates(self) -> Rates:
        steps, now = list(self._steps), time.perf_counter()
        steps = [step for step in steps if now - step[0] < WINDOW]
        health, simulation = self.snapshot.health, self.simulation
        if len(steps) < 2:
            return Rates(0.0, 0.0, simulation.frame_dt, health.substeps)
        between = steps[-1][0] - steps[0][0]
        overdue = now - steps[-1][0] - between / (len(steps) - 1)  # a step that is under way is not late yet
        took = max(between + max(overdue, 0.0), 1e-6)
        passed = steps[-1][1] - steps[0][1]
        return Rates((len(steps) - 1) / took, passed / took, simulation.frame_dt, health.substeps)

    # ---- in the thread

    def _ask(self, what: Callable[[], None]) -> None:
        with self._wake:
            self._asked.append(what)
            self._wake.notify_all()

    def _loop(self) -> None:
        while True:
            with self._wake:
                while not (self._closed or self._asked or self._changes or self._single or self._runs()):
                    self._wake.wait()
                if self._closed:
                    return
                asked, self._asked = self._asked, []
                changes, self._changes = self._changes, {}
                single, self._single = self._single and not self._broken, False
            for what in asked:
                self._safely(what)
            if changes:
                self._safely(partial(self._change, changes))
            if single or self._runs():
                self._advance(single)

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
        """One step, then wait until its time has come."""
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
                self._wake.wait_for(lambda: bool(self._closed or self._asked or self._changes), due - now)

    def pace(self, speed: float) -> None:
        """Set the wanted speed, in simulated seconds per second."""
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
        """Make the simulation anew; unless ``fresh``, it goes on from where it is if its nodes stay the same."""
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
    """A simulation of which a renderer on a CPU thins Gaussians that are much smaller than a pixel."""
    simulation.painter.renderer = make_renderer(simulation.device, detail=DETAIL)
    return simulation
