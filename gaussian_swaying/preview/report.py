"""The results of the preview as text and as plain numbers."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.repair import OPAQUE_LOGIT
from gaussian_swaying.geometry.origin import counted_from
from gaussian_swaying.preview.cost import Cost
from gaussian_swaying.preview.kinds import KINDS
from gaussian_swaying.preview.natural import Natural
from gaussian_swaying.preview.parts import FoundParts
from gaussian_swaying.preview.picture import mean_flow
from gaussian_swaying.preview.place import Place
from gaussian_swaying.preview.starter import region_dict
from gaussian_swaying.preview.suggest import MOST_CELLS, Suggestion, finest_spacing
from gaussian_swaying.preview.up import wind_words
from gaussian_swaying.simulation.measure import duration
from gaussian_swaying.simulation.simulation import Simulation, classify, conditions
from gaussian_swaying.wind.computed_air import resolution
from gaussian_swaying.wind.field import WindField

SHORT = ("origin", "up", "region", "held", "size", "kind", "wind", "simulated", "conditions", "the run")
"""Labels of the lines that are printed without ``--verbose``."""
NEXT_BEST = "the next best"


def splat_lines(name: str, cloud: GaussianCloud, data: dict[str, Any]) -> list[str]:
    """Bounds, opacities and shapes of the Gaussians."""
    corner, own = data["bounds"], data["gaussians"]
    below = ", ".join(f"{share:.0%} below {t}" for t, share in own["opacity_below"].items())
    infinite = own["opacity_0_or_1"]
    note = (
        f"  note: the opacity of {infinite:,} is exactly 0 or 1, an infinite logit, which is read as ±{OPAQUE_LOGIT:g}"
    )
    normals = "with normals" if own["normals"] else "without normals (the smallest axes are used)"
    degree = "only constant colours were read" if own["sh_degree"] is None else f"SH degree {own['sh_degree']}"
    return [
        f"{name}: {len(cloud):,} Gaussians, {degree}, {normals}",
        f"  bounds        {_numbers(corner['min'])} to {_numbers(corner['max'])} (scene units)",
        *([f"  origin        {counted_from(cloud.origin)}"] if any(cloud.origin) else []),
        f"  without 1 %   {_numbers(corner['robust_min'])} to {_numbers(corner['robust_max'])}",
        "  5, 50 and 95 % of the Gaussians have at most",
        f"    opacity     {_numbers(own['opacity'])}; {below}",
        f"    S1 / S2     {_numbers(own['S1_over_S2'])}   (needles are above 10)",
        f"    S2 / S3     {_numbers(own['S2_over_S3'])}   (surface patches are above 3)",
        f"    S1 / side   {_numbers(own['size_share'])}   (of the longest side; haze is above 0.1)",
        *([note] if infinite else []),
    ]


def shortened(report: str) -> str:
    """The lines of a report that a user needs first: what is simulated and how, each without its further reasons.

    Warnings are whole, with the command of the next best guess. ``--verbose`` prints the rest.
    """
    first, *lines = report.split("\n")
    kept = [first.split(", SH degree")[0]]
    said = {"region"} if "moves  " in report else set()
    said |= {"the run"} if "\nthe starter (" in report else set()
    whole = ("warning:", "the starter (", program.command("sim"))
    for line in lines:
        label = line[2:16].strip()
        if label in SHORT and label not in said:
            kept.append(line.split(";")[0])
        elif label.endswith("moves") or line.strip().startswith(whole) or line.endswith(NEXT_BEST):
            kept.append(line)
    return "\n".join(kept)


def place_lines(place: Place, chosen: Sequence[int]) -> list[str]:
    """The parts of a capture of a place, and how other things are chosen."""
    lines = [
        "",
        "a place: what stands on its ground may move, the likeliest first (things.png shows them)",
        f"  ground          {int(place.up.ground.sum()):,} Gaussians; they stay, and so does what is not chosen",
        f"  background      {int(place.far.sum()):,} far away, such as haze and sky",
    ]
    for number, thing in enumerate(place.things, start=1):
        why = ", ".join(f"{reason} (+{value:g})" for reason, value in thing.reasons.items())
        mark = "moves" if number in chosen else "     "
        size = " x ".join(f"{side:.3g}" for side in thing.size)
        lines.append(f"  {number} {mark}         {len(thing.members):,} Gaussians, {size} scene units; {why}")
    if len(place.things) > 1:
        lines.append("  other things: --move 2, or several as one object: --move 1,2")
    return lines


def place_dict(place: Place, chosen: Sequence[int]) -> dict[str, Any]:
    """The same as plain numbers."""
    things = [
        {"gaussians": len(t.members), "min": t.low, "max": t.high, "score": t.score, "reasons": t.reasons}
        for t in place.things
    ]
    ground, far = int(place.up.ground.sum()), int(place.far.sum())
    return {"ground": ground, "background": far, "things": things, "moves": list(chosen)}


def suggestion_lines(guess: Suggestion, further: int) -> list[str]:
    """The guesses, and the number of points that fill holes."""
    region = "all of space"
    if guess.region.box is not None:
        region = json.dumps(dict(zip(("min", "max"), guess.region.box, strict=True)))
    count = int(guess.region.simulated.sum())
    lines = [
        f"up              {_numbers(guess.up.direction)}, {_why(guess.up.confidence, '; '.join(guess.up.reasons))}",
        f"region          {region}: {guess.region.reason}",
        f"opacity         {guess.region.opacity_threshold:g} and above is simulated: {count:,} particles",
        f"held            at the {guess.hold.end}, {_why(guess.hold.confidence, guess.hold.reason)}"
        if guess.fixed
        else "held            nowhere: it will fall",
    ]
    if guess.pin is not None:
        lines.append(f"  pin           {_short(region_dict(guess.pin))}")
    if guess.parts is not None:
        lines.append(f"parts           {guess.parts.words()}; one object instead: --hold {guess.hold.option}")
        lines.append(f"  why           {guess.parts.reason}")
    lines += [
        f"size            {_numbers(guess.size)} m along the axes with z up; 1 scene unit = "
        f"{guess.metres_per_unit:.4g} m, assuming a longest side of {guess.longest_side:g} m",
        f"grid            quality {guess.quality}: dx = {guess.dx:g} m, {guess.longest_side / guess.dx:.0f} cells "
        f"along the longest side, {guess.dx / max(guess.spacing, 1e-30):.1f} times the particle spacing of "
        f"{guess.spacing:.3g} m",
        *_nodes(guess),
        "further points  " + (f"{further:,} where Gaussians are sparse for this grid" if further else "none needed"),
        f"kind            {_kind(guess)}",
        f"material        {_material(guess)}",
        f"wind            {guess.look}, {wind_words(guess.flow, guess.up.direction)}, with turbulence",
    ]
    return ["", "guesses (each can be set instead, see --help)", *(f"  {line}" for line in lines)]


def _nodes(guess: Suggestion) -> list[str]:
    """The line that says why connected parts have nodes of their own, if that was not asked for."""
    if not guess.connected_reason:
        return []
    words = "each connected part has its own (scene.connected: surface)"
    return [f"nodes           {words}, as {guess.connected_reason}; --connected grid leaves them shared"]


def area_line(run: dict[str, Any]) -> str:
    """The area in the wind, next to that of the convex hull, which is easily compared with the object itself."""
    return f"  area            {run['area_m2']:.3g} m^2 in the wind; the convex hull has {run['hull_area_m2']:.3g} m^2"


def run_lines(run: dict[str, Any]) -> list[str]:
    """Return lines of text about the scene that a given configuration simulates."""
    return [
        "",
        "this configuration",
        f"  simulated       {run['simulated']:,} of {run['gaussians']:,} Gaussians, {run['mass_kg']:.3g} kg; "
        f"box {_numbers(run['box_min'])} to {_numbers(run['box_max'])} (scene units)",
        area_line(run),
        f"  follow them     {run['carried']:,} faint or loose ones",
        f"  fill the inside {run['filled']:,} points; {run['further']:,} further points on large Gaussians",
        f"  conditions      {'; '.join(run['conditions']) or 'none: it will fall'}",
        *(f"                  {region}" for region in run["regions"]),
        f"  frame           {run['frame']}",
        f"  grid            dx = {run['dx_m']:g} m, {run['formulation']}",
        f"  wind            {wind_words(run['flow'], run['up'])}, before modulations",
        *([f"  air             {run['air']}"] if run["air"] else []),
    ]


def cost_lines(cost: Cost) -> list[str]:
    """The cost of a run."""
    frame = cost.substeps * cost.substep_seconds
    picture = ""
    if cost.picture_seconds is not None:
        picture = f" + {duration(cost.picture_seconds)} for its pictures"
    return [
        "",
        f"cost on this machine ({cost.device})",
        f"  substep         {cost.substep:.3g} s, {cost.substeps} per frame ({_stable(cost)})",
        f"  work            {cost.particles:,} particles x {cost.substeps} substeps x {cost.frames} frames = "
        f"{cost.particles * cost.substeps * cost.frames:.2g}; grid of {' x '.join(map(str, cost.grid))} nodes",
        f"  a frame         {duration(frame)}{picture}, from {duration(cost.substep_seconds)} per substep",
        f"  the run         about {duration(cost.total_seconds)}, if nothing else runs",
    ]


def _stable(cost: Cost) -> str:
    if math.isinf(cost.stable_substep):
        return "modes, which are stable with any"
    return f"stable up to {cost.stable_substep:.3g} s; waves of {cost.wave_speed:.3g} m/s"


def quality_lines(
    guess: Suggestion, cost: Cost, minutes: float | None, grids: dict[str, float], others: dict[str, float]
) -> list[str]:
    """Return lines of text: the reason for the grid of the starter, and the cost of the other qualities.

    Args:
        guess: The guesses, with the chosen grid.
        cost: The cost of the starter.
        minutes: The wanted time [minutes], if there is one.
        grids: Grid spacings of the qualities [m].
        others: Times of a run with the other ones [s], from scaling.
    """
    cells = guess.longest_side / guess.dx
    chosen = f"  quality         {guess.quality}: {cells:.0f} cells along the longest side"
    lines = [chosen]
    if minutes is not None:
        wish = duration(60 * minutes)
        if cost.total_seconds > 60 * minutes:
            lines[0] = (
                f"warning: Even a draft takes about {duration(cost.total_seconds)}, longer than {wish}: ask for fewer "
                "`--frames`. The starter has the grid of a draft."
            )
        else:
            why = f"the finest grid that takes at most {wish}"
            if guess.dx <= finest_spacing(guess):
                limited = guess.dx > 1.02 * guess.longest_side / MOST_CELLS
                why = "the finest for Gaussians so far apart" if limited else "the finest that a preview chooses"
            lines[0] = f"{chosen}, {why}"
    for name, seconds in others.items():
        if grids[name] == guess.dx:
            lines.append(f"    {name:<13} the same grid")
        else:
            lines.append(f"    {name:<13} about {duration(seconds)} with dx = {grids[name]:g} m (--quality {name})")
    return lines


def _numbers(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value + 0.0:.3g}" for value in values) + "]"


def _kind(guess: Suggestion) -> str:
    words = f"{guess.kind} ({KINDS[guess.kind].words}): {guess.kind_reason}"
    n = guess.natural
    if n is None:
        return words
    how = f"{n.frequency:.3g} Hz in still air, leans by {n.lean:.2%} of its longest side"
    by = "modes" if guess.by_modes else "material points"
    still = "; there is little to sway" if guess.kind == "rigid" else ""
    return f"{words}; {how}; by {by}, as {guess.why_formulation}{still}"


def _material(guess: Suggestion) -> str:
    numbers = f"E = {guess.youngs_modulus:.2g} Pa, {guess.density:.3g} kg/m^3, {guess.thickness:.2g} m thick"
    if guess.real:
        return f"{guess.material}, {numbers}: as it was given"
    moving = "" if guess.natural is None else f"; {guess.natural.mass:.2g} kg move"
    return f"{guess.material}, {numbers}{moving}"


def _why(confidence: str, reason: str) -> str:
    return "given" if confidence == "given" else f"confidence {confidence}: {reason}"


def _short(region: dict[str, Any]) -> str:
    return json.dumps(region["init_args"]) if region["class_path"] == "Box" else json.dumps(region)


def preview_command(options: argparse.Namespace, defaults: argparse.Namespace, **changes: str | list[str]) -> str:
    """The command line of the preview with these options, some of them changed.

    Args:
        options: The given options.
        defaults: Default values, which are left out.
        changes: Options to change, by their names in ``options``.
    """
    words = ["preview", options.scene]
    for name, default in vars(defaults).items():
        value = changes.get(name, getattr(options, name, default))
        if name == "scene" or value is None or value == default:
            continue
        words.append("--" + name.replace("_", "-"))
        if value is True:
            continue
        listed = isinstance(value, Sequence) and not isinstance(value, str)
        words += [f"{v:g}" if isinstance(v, float) else str(v) for v in (value if listed else [value])]
    return program.command(*words)


def doubts(guess: Suggestion, options: argparse.Namespace, defaults: argparse.Namespace) -> list[str]:
    """Warnings about weak guesses, each with the command for the guess and the one for the next best.

    Args:
        guess: The guesses.
        options: Options of the preview.
        defaults: Their defaults.

    Returns:
        Lines of text; none if all guesses are good.
    """
    lines: list[str] = []
    if guess.region.confidence == "low" and guess.region.box is not None:
        count, box = int(guess.region.simulated.sum()), [f"{c:g}" for corner in guess.region.box for c in corner]
        lines.append(f"warning: that these {count:,} Gaussians are the object is a weak guess; check the picture:")
        lines.append(f"  {preview_command(options, defaults, region=box)}   # as guessed: give another box")
    if guess.up.confidence == "low":
        lines.append("warning: the up axis is a weak guess; check the picture, and set it:")
        for name, words in zip(guess.up.options, ("as guessed", NEXT_BEST), strict=False):
            lines.append(f"  {preview_command(options, defaults, up=name.split())}   # {words}")
    if guess.hold.confidence == "low":
        lines.append(
            f"warning: that it is held at the {guess.hold.end} is a weak guess; check the picture, and set it:"
        )
        for name, words in zip(guess.hold.options, ("as guessed", NEXT_BEST), strict=False):
            lines.append(f"  {preview_command(options, defaults, hold=name)}   # {words}")
    return lines


# ---- as plain numbers, for preview.json


def suggestion_dict(guess: Suggestion) -> dict[str, Any]:
    """A suggestion without its masks."""
    region = guess.region.region()
    return {
        "up": {
            "direction": list(guess.up.direction),
            "confidence": guess.up.confidence,
            "scores": guess.up.scores,
            "reasons": guess.up.reasons,
            "floor_gaussians": int(guess.up.ground.sum()),
        },
        "region": {
            "region": None if region is None else region_dict(region),
            "simulated": int(guess.region.simulated.sum()),
            "opacity_threshold": guess.region.opacity_threshold,
            "specks": guess.region.specks,
            "reason": guess.region.reason,
        },
        "hold": asdict(guess.hold) | {"region": None if guess.pin is None else region_dict(guess.pin)},
        "parts": None if guess.parts is None else _parts_dict(guess.parts),
        "longest_side_m": guess.longest_side,
        "metres_per_unit": guess.metres_per_unit,
        "size_m": list(guess.size),
        "spacing_m": guess.spacing,
        "dx_m": guess.dx,
        "quality": guess.quality,
        "sheet": guess.sheet,
        "azimuth": guess.azimuth,
        "flow": list(guess.flow),
        "material": guess.material,
        "youngs_modulus_Pa": guess.youngs_modulus,
        "thickness_m": guess.thickness,
        "density_kg_m3": guess.density,
        "look": guess.look,
        "kind": {"name": guess.kind, "reason": guess.kind_reason},
        "formulation": "modes" if guess.by_modes else "total",
        "formulation_reason": guess.why_formulation,
        "natural": None if guess.natural is None else _natural_dict(guess.natural),
    }


def _natural_dict(found: Natural) -> dict[str, float]:
    return {
        "frequency_Hz": found.frequency,
        "length_m": found.height,
        "mass_kg": found.mass,
        "silhouette_m2": found.frontal,
        "lean": found.lean,
    }


def _parts_dict(parts: FoundParts) -> dict[str, Any]:
    of_part = {
        part.name: {"role": part.role, "gaussians": int(parts.parts.mask(part.name).sum())}
        for part in parts.parts.parts
    }
    return {"parts": of_part, "reason": parts.reason}


def run_dict(simulation: Simulation) -> dict[str, Any]:
    """The simulated part, the pins and the wind of a run."""
    parts, scene = classify(simulation), simulation.scene
    return {
        "gaussians": len(scene.model.means),
        "simulated": int(parts.simulated.sum()),
        "carried": int(parts.carried.sum()),
        "loose": scene.loose,
        "held": int(parts.pinned.sum()),
        "conditions": parts.names,
        "regions": [repr(b.region) for b in conditions(simulation) if hasattr(b, "region")],
        "frame": scene.frame.describe(),
        "box_min": [float(v) for v in scene.bounds[0]],
        "box_max": [float(v) for v in scene.bounds[1]],
        "mass_kg": float(scene.points.mass.sum()),
        "area_m2": float(scene.patches.area.sum()),
        "hull_area_m2": scene.hull_area(),
        "filled": scene.filled,
        "points": scene.points.count,
        "further": scene.further,
        "dx_m": simulation.solver.dx,
        "formulation": simulation.solver.formulation,
        "flow": mean_flow(simulation).tolist(),
        "up": scene.frame.rotation[2].tolist(),
        "air": _air(simulation),
    }


def _air(simulation: Simulation) -> str | None:
    """Cost and resolution of the box of computed air; None without one."""
    air, wind = simulation.stepper.model.air, simulation.wind
    if air is None or not isinstance(wind, WindField):
        return None
    return str(resolution(air, wind, simulation.frame_dt, simulation.scene.points.position))


def cost_dict(cost: Cost) -> dict[str, Any]:
    """A cost with its total."""
    return asdict(cost) | {"total_seconds": cost.total_seconds}
