"""The grid of the live page: the finest one on which this machine keeps up with real time, found by short trials."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from gaussian_swaying.simulation.body import suggest_spacing
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.cost import Cost, estimate_cost
from gaussian_swaying.suggestion.suggest import QUALITIES
from gaussian_swaying.viewer.changes import changed_settings

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

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
        simulation: Their simulation.
        sentence: What was chosen, and how to get the configured grid.
    """

    settings: Namespace
    simulation: Simulation
    sentence: str


def in_real_time(parser: ArgumentParser, settings: Namespace, simulation: Simulation) -> Choice:
    """Choose the finest grid, not finer than the configured one, on which this machine keeps up with real time.

    Args:
        parser: From :meth:`Simulation.parser`.
        settings: The settings as they were configured.
        simulation: Their simulation.
    """
    configured = float(settings.solver.dx)
    made = {configured: (settings, simulation)}
    frames = 1 + max(1, round(MOTION / simulation.frame_dt))

    def measure(dx: float) -> Cost:
        if dx not in made:
            changed = changed_settings(parser, settings, {"solver.dx": dx})
            made[dx] = changed, Simulation.from_settings(parser, changed)
        cost = estimate_cost(made[dx][1], frames, budget=BUDGET, pictures=False)
        return replace(cost, startup_seconds=0.0, dx=dx)

    seconds, scene = (frames - 1) * simulation.frame_dt, simulation.scene
    coarsest = suggest_spacing(scene.size * scene.frame.metres_per_unit, 0.0, QUALITIES["draft"])
    first, found = finest_in_real_time(measure, seconds, configured, coarsest)
    speeds = seconds / first.total_seconds, seconds / found.total_seconds
    return Choice(*made[found.dx], sentence(configured, found.dx, *speeds))


def finest_in_real_time(
    measure: Callable[[float], Cost], seconds: float, configured: float, coarsest: float
) -> tuple[Cost, Cost]:
    """The cost on the configured grid, and on the finest one that is :data:`HEADROOM` times as fast as real time.

    If none of those tried is so fast, the second is the fastest.

    Args:
        measure: Function that estimates the cost for a grid spacing [m]; called for few.
        seconds: Length of the motion whose cost it estimates [s].
        configured: Smallest grid spacing [m].
        coarsest: Largest grid spacing [m]; if it is less than ``configured``, that one is kept.
    """
    wish, first = seconds / HEADROOM, measure(configured)
    if first.total_seconds <= wish or configured >= coarsest:
        return first, first
    tried = [first]
    for _ in range(TRIALS):
        dx = _predicted(tried, wish / MARGIN, configured, coarsest)
        if any(dx == cost.dx or (cost.total_seconds <= wish and abs(dx / cost.dx - 1) < CLOSE) for cost in tried):
            break
        try:
            tried.append(measure(dx))
        except ValueError:  # too coarse for a pin, for example
            coarsest = math.sqrt(configured * dx)
    fitting = [cost for cost in tried if cost.total_seconds <= wish]
    if fitting:
        return first, min(fitting, key=lambda cost: cost.dx)
    return first, min(tried, key=lambda cost: cost.total_seconds)


def _predicted(tried: list[Cost], seconds: float, finest: float, coarsest: float) -> float:
    """The finest grid spacing on which a motion should take at most some time [m], rounded up to two digits.

    The time grows with a power of 1 / dx: that between the two grids nearest to the time, or the third of a surface.
    """
    near, *others = sorted(tried, key=lambda cost: abs(math.log(cost.total_seconds / seconds)))
    power = SURFACE
    if others and abs(math.log(others[0].dx / near.dx)) > CLOSE:
        power = math.log(others[0].total_seconds / near.total_seconds) / math.log(near.dx / others[0].dx)
    dx = near.dx * (near.total_seconds / seconds) ** (1 / min(max(power, 1.0), 4.0))
    unit = 10.0 ** (math.floor(math.log10(dx)) - 1)
    return min(max(float(f"{math.ceil(dx / unit - 1e-6) * unit:.2g}"), finest), coarsest)


def sentence(configured: float, chosen: float, configured_speed: float, speed: float) -> str:
    """Says which grid was chosen, and how to get the configured one.

    Args:
        configured: Its spacing [m].
        chosen: Spacing of the grid that was chosen [m].
        configured_speed: Simulated seconds per second on the configured grid.
        speed: The same on the one that was chosen.
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
