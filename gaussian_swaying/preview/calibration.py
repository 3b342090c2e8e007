"""Stiffness, thickness and wind that make a scene sway as far as wanted, found by short runs of the scene.

A small deflection is proportional to wind² / (E thickness). So a run shows by what factor E thickness / wind² must
change, and the next run checks the result. The method does not depend on what the object is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from gaussian_swaying.geometry.linalg import matmul3, symmetric_eigenvalues
from gaussian_swaying.preview.shape import quantile
from gaussian_swaying.preview.suggest import Suggestion
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.parameters import thicker, value_of, with_values
from gaussian_swaying.simulation.simulation import Simulation

SWAY = 0.10  # wanted largest displacement, as a share of the longest side
SOFTEST, STIFFEST = 3e4, 1e6  # Pa; ten times the stiffness needs three times the substeps
THINNEST, THICKEST = 0.003, 0.03  # of the longest side
STRETCH = (0.75, 1.35)  # target range, so that a longer run stays between 0.7 and 1.4
CLOSE = 1.2  # a share within this factor of the wanted one is good enough
MOST_RUNS = 6
SECONDS = 1.6  # length of a run: the first peak of the sway, at 0.5 s, and the swing after it
STOP = 4.0  # a run is stopped when it has moved this many times too far
MOVED = 0.99  # quantile of the displacements that is used, so that single specks do not count
STRETCHED = 0.001  # share of the particles that may be stretched or compressed further


@dataclass(frozen=True)
class Motion:
    """The motion of a scene in a run: displacement and stretch.

    Attributes:
        share: Largest displacement (the :data:`MOVED` quantile over the particles) as a share of the longest side.
        stretch_min: Smallest stretch of all but :data:`STRETCHED` of the particles.
        stretch_max: Largest stretch of all but :data:`STRETCHED` of the particles.
        complete: False if the run was stopped because the scene moved much too far.
        growth: Mean substeps of a frame over those of the first, as a material may stiffen when it is stretched.
    """

    share: float
    stretch_min: float
    stretch_max: float
    complete: bool = True
    growth: float = 1.0

    @property
    def strain(self) -> float:
        """Distance of the stretch from 1 as a share of the allowed distance; above 1 it is too large."""
        low, high = STRETCH
        return max((1 - self.stretch_min) / (1 - low), (self.stretch_max - 1) / (high - 1), 1e-6)


@dataclass(frozen=True)
class Setting:
    """The values to calibrate.

    Attributes:
        E: Young's modulus [Pa].
        thickness: Thickness of the surface [m].
        wind: Factor on the given wind, at most 1.
    """

    E: float
    thickness: float
    wind: float = 1.0


@dataclass(frozen=True)
class Calibration:
    """The result of the calibration.

    Attributes:
        setting: The values, to two digits.
        motion: Motion of the scene with them.
        runs: Number of runs.
        reason: The reason, in words.
    """

    setting: Setting
    motion: Motion
    runs: int
    reason: str


def check_sway(sway: float) -> None:
    """Raise ValueError unless a largest displacement, as a share of the longest side, is within range."""
    if not 0.01 <= sway <= 0.5:
        raise ValueError(f"Expected `--sway` to be a share of the longest side from 0.01 to 0.5, but got {sway:g}.")


def calibrate(
    measure: Callable[[Setting], Motion], start: Setting, side: float, sway: float | None = SWAY
) -> Calibration:
    """Find the setting for which a scene moves by ``sway`` and nothing is stretched too far.

    E is changed first, then the thickness, which costs no time, and finally the wind is reduced.

    Args:
        measure: Function that runs the scene with a setting.
        start: The first setting.
        side: Longest side of the object [m].
        sway: Wanted largest displacement, as a share of the longest side. None for a sheet, which may move as far as
            the wind takes it: then E is raised until the sheet is not stretched too far, and nothing else changes.

    Returns:
        The best of the settings that were run.

    Raises:
        ValueError: If ``sway`` is out of range.
    """
    if sway is not None:
        check_sway(sway)
    setting = start
    tried: list[tuple[Setting, Motion]] = []
    while True:
        motion = measure(setting)
        tried.append((setting, motion))
        hold, good = (
            1.05 * motion.strain,
            motion.complete and motion.strain <= 1,
        )  # to the limit of the stretch
        if sway is not None:
            miss = motion.share / sway
            good = good and miss <= CLOSE and max(miss, hold) >= 1 / CLOSE
            hold = max(hold, miss ** (1 / _response(tried)))
        following = adjusted(setting, hold, start, side, sway is None)
        if good or following == setting or len(tried) == MOST_RUNS:
            break
        setting = following
    best, motion = min(tried, key=lambda entry: _badness(entry[1], sway))
    return Calibration(best, motion, len(tried), describe(best, motion, sway))


def adjusted(setting: Setting, hold: float, start: Setting, side: float, only_E: bool = False) -> Setting:
    """A setting that is ``hold`` times as resistant to the wind.

    Args:
        setting: The last one.
        hold: Factor on E thickness / wind².
        start: The first setting; its thickness is kept if changing E is enough.
        side: Longest side of the object [m].
        only_E: Change only E.

    Returns:
        The new setting, with values within bounds and rounded to two digits.
    """
    hold = min(max(hold, 0.03), 30.0)
    if only_E:
        return replace(setting, E=_two_digits(min(setting.E * hold, STIFFEST)))
    wanted = hold * setting.E * setting.thickness / setting.wind**2
    stiffness = min(max(wanted / start.thickness, SOFTEST), STIFFEST)
    thickness = min(max(wanted / stiffness, THINNEST * side), THICKEST * side)
    wind = min(1.0, math.sqrt(stiffness * thickness / wanted))
    return Setting(_two_digits(stiffness), _two_digits(thickness), _two_digits(wind))


def describe(setting: Setting, motion: Motion, sway: float | None) -> str:
    """The result of a calibration, in words."""
    moved = f"{motion.share:.2g} of the longest side" if motion.complete else "much too far"
    words = [f"in {SECONDS:g} s of this wind 99 % of it moves by at most {moved}"]
    if setting.wind < 1:
        words.append(f"the wind was reduced to {setting.wind:g} of the given one, as a stiffer object costs too much")
    if motion.strain > 1:
        words.append(
            f"parts are stretched to between {motion.stretch_min:.2g} and {motion.stretch_max:.2g} of their length: "
            "pin more of it, or set a smaller --sway or --wind"
        )
    elif sway is not None and motion.complete and motion.share < sway / CLOSE**2:
        words.append("it hardly moves: raise --wind" if motion.strain < 0.8 else "more wind would stretch it")
    return "; ".join(words)


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}")


def _response(tried: list[tuple[Setting, Motion]]) -> float:
    """The exponent with which the displacement falls as the resistance grows, from the last two runs, else 1."""
    done = [(s.E * s.thickness / s.wind**2, m.share) for s, m in tried[-2:] if m.complete and m.share > 0]
    if len(done) < 2 or abs(math.log(done[1][0] / done[0][0])) < 0.1:
        return 1.0
    (hold, share), (other_hold, other_share) = done
    return min(max(-math.log(other_share / share) / math.log(other_hold / hold), 0.5), 1.5)


def _badness(motion: Motion, sway: float | None) -> float:
    """Zero for a motion as wanted, and larger the farther it is from that."""
    miss = 0.0 if sway is None else abs(math.log(max(motion.share, 1e-9) / sway))
    return miss + 3 * max(math.log(motion.strain), 0.0) + (0.0 if motion.complete else 100.0)


# ---- the run


def apply_setting(simulation: Simulation, setting: Setting, base: Setting) -> None:
    """Change the setting of a run from ``base`` to another one, before it starts."""
    setup = simulation.setup
    wind = {"wind.flow": [setting.wind / base.wind * part for part in value_of(setup, "wind.flow")]}
    material = {"material.E": setting.E} if setting.E != base.E else {}
    simulation.adopt(thicker(with_values(setup, wind | material), setting.thickness / base.thickness))


@torch.inference_mode()
def measure_motion(
    simulation: Simulation,
    setting: Setting,
    base: Setting,
    sway: float | None = None,
    seconds: float = SECONDS,
) -> Motion:
    """Run a scene from rest with another setting, without pictures; the scene itself does not change.

    Args:
        simulation: The run, with material and wind of ``base``.
        setting: The setting to try.
        base: The setting of the simulation.
        sway: The run is stopped as soon as it moved :data:`STOP` times this share of the longest side; None for never.
        seconds: Time to simulate [s].

    Returns:
        The motion; not complete if the run was stopped or diverged.
    """
    before, scene = simulation.setup, simulation.scene
    points = scene.points
    apply_setting(simulation, setting, base)
    side = scene.size * scene.frame.metres_per_unit
    limit = math.inf if sway is None else STOP * sway
    motion, threads = Motion(0.0, 1.0, 1.0), torch.get_num_threads()
    if not simulation.solver.has_kernels:
        torch.set_num_threads(1)  # for a few hundred particles torch's threads would only wait for each other
    try:
        state, taken = simulation.start(), []
        for _ in range(max(1, round(seconds / simulation.frame_dt))):
            state, health = simulation.advance(state)
            taken.append(health.substeps)
            moved = torch.linalg.vector_norm(state.position - points.position, dim=-1)
            F = state.F_total.double()
            stretch = symmetric_eigenvalues(matmul3(F.mT, F)).clamp(min=0).sqrt()
            motion = Motion(
                max(motion.share, quantile(moved, MOVED) / side),
                min(motion.stretch_min, quantile(stretch.amin(-1), STRETCHED)),
                max(motion.stretch_max, quantile(stretch.amax(-1), 1 - STRETCHED)),
                growth=sum(taken) / (len(taken) * taken[0]),
            )
            if motion.share > limit:
                return replace(motion, complete=False)
    except SimulationDiverged:
        return Motion(max(motion.share, min(limit, 1.0)), 0.0, 10.0, complete=False)
    finally:
        torch.set_num_threads(threads)
        simulation.adopt(before)
    return motion


def calibrated_suggestion(suggestion: Suggestion, draft: Simulation, sway: float) -> Suggestion:
    """The suggestion with stiffness, thickness and wind from short runs of its draft; the draft is changed too."""
    if suggestion.real or not suggestion.fixed or not any(suggestion.flow):
        return suggestion
    start, wanted = Setting(suggestion.youngs_modulus, suggestion.thickness), None if suggestion.sheet else sway
    best = calibrate(lambda tried: measure_motion(draft, tried, start, wanted), start, suggestion.longest_side, wanted)
    apply_setting(draft, best.setting, start)
    return replace(
        suggestion,
        youngs_modulus=best.setting.E,
        thickness=best.setting.thickness,
        flow=tuple(round(c * best.setting.wind, 2) for c in suggestion.flow),
        stiffness_reason=best.reason,
        growth=best.motion.growth,
    )
