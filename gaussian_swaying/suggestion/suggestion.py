"""A suggestion as sentences, as plain numbers, and as a YAML file with comments."""

from __future__ import annotations

import json
import math
import os
import textwrap
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from gaussian_swaying import _program as program
from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.hold import hold_option
from gaussian_swaying.gaussians.measures import Array, Guess
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.geometry.regions import Box, Cylinder, Not, Region, Union
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.modes import MOST_LEAN
from gaussian_swaying.simulation.measure import duration
from gaussian_swaying.simulation.simulation import Simulation, classify, conditions
from gaussian_swaying.suggestion.cost import Cost
from gaussian_swaying.suggestion.kinds import KINDS
from gaussian_swaying.suggestion.moves import Moving, Place
from gaussian_swaying.suggestion.natural import Natural
from gaussian_swaying.suggestion.parts import FoundParts
from gaussian_swaying.suggestion.picture import mean_flow, preview_picture, things_picture
from gaussian_swaying.suggestion.up import vector_words, wind_words
from gaussian_swaying.wind.turbulence import CELLS, LOOKS, turbulence_length

PICTURE = (960, 540)
FRAME_DT = 0.04  # s


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Everything that a first simulation of a splat needs.

    Attributes:
        path: Its file, if there is one.
        ground: Which of the Gaussians ``near`` are a floor, bool.
        moving: Which of them are simulated.
        hold: The end at which it is held.
        pin: That end as a region, None if it is not held, or is a part of ``parts`` that is.
        longest_side: Assumed length of the longest side of the object, without what is still [m].
        metres_per_unit: Resulting length of a scene unit [m].
        size: Sides of the object along the z-up axes [m].
        spacing: Particle spacing [m], see :func:`particle_spacing`.
        dx: Grid spacing [m].
        quality: Which quality that is, one of ``QUALITIES``.
        sheet: Whether the object is a thin sheet.
        azimuth: Azimuth of a camera that sees the broad side, or the side seen in photos [degrees].
        flow: Wind across the picture, or along a sheet from its held side [m/s], z up.
        look: The name of the wind, one of :data:`~gaussian_swaying.wind.turbulence.LOOKS`.
        kind: What it is, one of :data:`~gaussian_swaying.suggestion.kinds.KINDS`.
        material: The known material of its surface, of the kind or as it was given.
        youngs_modulus: Young's modulus [Pa].
        density: Density of the surface [kg/m³].
        thickness: Thickness of the surface [m].
        whole: Corners of the box of the whole object, including parts that do not move [scene units].
        camera: Vector from the centre of the moving part to that of the whole, and distance of a camera that shows the
            whole, in multiples of the longest side of the moving part.
        parts: The parts of the object, if they are sure: a plant in a pot, a flag on its pole, what hangs from a cord,
            or a tree; else None.
        start: Time at which a typical stretch of the turbulence begins [s].
        drag: Factor on the coefficients of the wind's force.
        natural: Frequency, mass and lean of the kind, if it sways by modes or could.
        connected: ``scene.connected`` of the simulation.
        connected_reason: Why it is ``surface``, in words.
        real: Whether the numbers are those of a material that was given; if not, it sways as its kind does.
        near: Which Gaussians of a place, or below a sky, were looked at, bool; None for all.
        place: The things of a place; None for an object.
        moves: Numbers of those that move.
        simulation: The simulation of the Gaussians ``near``, with these numbers.
        seconds: Time to read the splat and to make that simulation [s].
    """

    cloud: GaussianCloud
    path: Path | None
    up: Guess
    ground: Array
    moving: Moving
    hold: Guess
    pin: Region | None
    longest_side: float
    metres_per_unit: float
    size: tuple[float, ...]
    spacing: float
    dx: float
    quality: str
    sheet: bool
    azimuth: float
    flow: tuple[float, ...]
    look: str
    kind: str
    kind_reason: str
    material: str
    youngs_modulus: float
    density: float
    thickness: float
    whole: tuple[list[float], list[float]]
    camera: tuple[list[float], float]
    parts: FoundParts | None = None
    start: float = 0.0
    drag: float = 1.0
    natural: Natural | None = None
    connected: str = "grid"
    connected_reason: str = ""
    real: bool = False
    near: Array | None = None
    place: Place | None = None
    moves: tuple[int, ...] = ()
    simulation: Simulation | None = None
    seconds: float = 0.0

    def __repr__(self) -> str:
        return f"Suggestion({self.kind}: {int(self.moving.simulated.sum()):,} Gaussians, held at the {self.hold.name})"

    @property
    def fixed(self) -> bool:
        return self.pin is not None or self.parts is not None

    @property
    def falls(self) -> bool:
        """True if it has weight: cloth, and what nothing holds; all else was captured in balance with its weight."""
        return KINDS[self.kind].cloth or not self.fixed

    @property
    def sways(self) -> bool:
        """True if its numbers are its kind's: it is held, is no cloth, and no material was given."""
        return self.fixed and not self.real and not KINDS[self.kind].cloth

    @property
    def by_modes(self) -> bool:
        """True if modes suffice: it leans by less than :data:`MOST_LEAN`, or turns rigidly, which is exact."""
        little = self.natural is None or self.natural.lean < MOST_LEAN or self.kind == "hanging"
        return self.sways and little

    @property
    def why_formulation(self) -> str:
        if self.by_modes:
            how = "turns as one" if self.kind == "hanging" else "leans by less than 40 %"
            return f"it is held, nothing touches, and it {how}"
        if self.sways:
            return "it leans by more than 40 %, which modes cannot do"
        if self.real:
            return "a material was given"
        return "cloth folds" if self.fixed else "nothing holds it"

    @property
    def reasons(self) -> dict[str, str]:
        return reasons_of(self)

    def picture(self, height: int = 540) -> Array:
        """The splat with the simulated part, the pins, the wind and normals from two sides, 8-bit RGB, (H, W, 3)."""
        return preview_picture(self.simulation or self.to_simulation(), height, self.whole)

    def things(self) -> Array | None:
        """A picture of the things of a place, 8-bit RGB, shape (H, W, 3); None for an object."""
        device = torch.device("cpu") if self.simulation is None else self.simulation.device
        return None if self.place is None else things_picture(self.cloud, self.place, self.moves, device)

    def to_simulation(self, device: str = "auto") -> Simulation:
        parser = Simulation.parser()
        with TemporaryDirectory() as folder:
            text = self.to_yaml(Path(folder) / "starter.yaml", splat=self.path or Path("splat.ply"))
            settings = parse_text(parser, text, ["--device", device])
            return Simulation.from_settings(parser, settings, cloud=self.cloud)

    def to_yaml(self, file: str | os.PathLike[str], frames: int = 250, splat: Path | None = None) -> str:
        """Write the simulation as a configuration with a comment on each number, and beside it ``parts.npz``.

        Args:
            file: The configuration; Gaussians without a file of their own are written beside it.
            splat: The file of the Gaussians that it names; ``path`` if None.
        """
        folder = Path(file).resolve().parent
        splat = splat or self.path
        if splat is None:
            splat = folder / "splat.ply"
            write_ply(splat, self.cloud)
        if self.parts is not None:
            self.parts.parts.save(folder / "parts.npz")
        text = configuration(self, splat, folder / "parts.npz", frames)
        Path(file).write_text(text, encoding="utf-8")
        return text


def reasons_of(s: Suggestion) -> dict[str, str]:
    """What was guessed and why: sentences by name. Further reasons follow a semicolon."""
    moving, held = s.moving, s.hold
    region = "all of space" if moving.box is None else json.dumps(dict(zip(("min", "max"), moving.box, strict=True)))
    found = {
        "up": f"{vector_words(s.up.direction)}, {_why(s.up.confidence, s.up.reasons)}",
        "region": f"{region}: {moving.reason}",
        "opacity": f"{moving.opacity_threshold:g} and above is simulated: {moving.simulated.sum():,} particles",
        "held": f"at the {held.name}, {_why(held.confidence, held.reasons)}" if s.fixed else "nowhere: it will fall",
    }
    if s.pin is not None:
        found["pin"] = repr(s.pin)
    if s.parts is not None:
        found["parts"] = f"{s.parts.words()}; {s.parts.reason}; one object instead: --hold {hold_word(s)}"
    if s.connected_reason:
        found["nodes"] = f"each connected part has its own (scene.connected: surface), as {s.connected_reason}"
    further = 0 if s.simulation is None else s.simulation.scene.further
    kind = f"{s.kind} ({KINDS[s.kind].words}): {s.kind_reason}"
    if s.natural is not None:
        kind += f"; {s.natural.frequency:.3g} Hz in still air, leans by {s.natural.lean:.2%} of its longest side; by "
        kind += f"{'modes' if s.by_modes else 'material points'}, as {s.why_formulation}"
        kind += "; there is little to sway" if s.kind == "rigid" else ""
    why = "as it was given" if s.real else "" if s.natural is None else f"{s.natural.mass:.2g} kg move"
    material = f"{s.material}, E = {s.youngs_modulus:.2g} Pa, {s.density:.3g} kg/m^3, {s.thickness:.2g} m thick"
    return found | {
        "size": f"{vector_words(s.size)} m along the axes with z up; 1 scene unit = {s.metres_per_unit:.4g} m, "
        f"assuming a longest side of {s.longest_side:g} m",
        "grid": f"quality {s.quality}: dx = {s.dx:g} m, {s.longest_side / s.dx:.0f} cells along the longest side, "
        f"{s.dx / max(s.spacing, 1e-30):.1f} times the particle spacing of {s.spacing:.3g} m; "
        f"{further:,} further points where Gaussians are sparse for it",
        "kind": kind,
        "material": f"{material}; {why}" if why else material,
        "wind": f"{s.look}, {wind_words(s.flow, s.up.direction)}, with turbulence",
    }


def _why(confidence: str, reasons: tuple[str, ...]) -> str:
    return "given" if confidence == "given" else f"confidence {confidence}: {'; '.join(reasons)}"


def hold_word(s: Suggestion) -> str:
    """The value of ``--hold`` for the end at which it is held."""
    return s.hold.options[0] if s.hold.options else hold_option(s.hold.name, s.hold.direction)


def things_lines(s: Suggestion) -> list[str]:
    """Lines on the parts of a capture of a place, and how to choose other things."""
    if s.place is None:
        return []
    lines = [
        "a place: what stands on its ground may move, the likeliest first (things.png shows them)",
        f"  ground          {s.place.ground.sum():,} Gaussians; they stay, and so does what is not chosen",
        f"  background      {s.place.far.sum():,} far away, such as haze and sky",
    ]
    for number, thing in enumerate(s.place.things, start=1):
        why = ", ".join(f"{reason} (+{value:g})" for reason, value in thing.reasons.items())
        mark = "moves" if number in s.moves else "     "
        size = " x ".join(f"{b - a:.3g}" for a, b in zip(thing.low, thing.high, strict=True))
        lines.append(f"  {number} {mark}         {len(thing.members):,} Gaussians, {size} scene units; {why}")
    if len(s.place.things) > 1:
        lines.append("  other things: --move 2, or several as one object: --move 1,2")
    return lines


def cost_lines(cost: Cost) -> list[str]:
    """The cost of a run."""
    picture = "" if cost.picture_seconds is None else f" + {duration(cost.picture_seconds)} for its pictures"
    return [
        f"cost on this machine ({cost.device})",
        f"  work            {cost.particles:,} particles x {cost.substeps} substeps x {cost.frames} frames; grid of "
        f"{' x '.join(map(str, cost.grid))} nodes",
        f"  a frame         {duration(cost.substeps * cost.substep_seconds)}{picture}",
        f"  the run         about {duration(cost.total_seconds)}, if nothing else runs",
    ]


def run_lines(simulation: Simulation) -> list[str]:
    """Lines on what a configuration simulates, where it is held, and its wind."""
    scene, roles = simulation.scene, classify(simulation)
    regions = [repr(b.region) for b in conditions(simulation) if hasattr(b, "region")]
    mass, area = float(scene.points.mass.sum()), float(scene.patches.area.sum())
    flow, up = mean_flow(simulation).tolist(), scene.frame.rotation[2].tolist()
    low, high = (vector_words(bound.tolist()) for bound in scene.bounds)
    lines = {
        "simulated": f"{int(roles.simulated.sum()):,} of {len(scene.model.means):,} Gaussians, {mass:.3g} kg; box "
        f"{low} to {high} (scene units)",
        "area": f"{area:.3g} m^2 in the wind; the convex hull has {scene.hull_area():.3g} m^2",
        "follow them": f"{int(roles.carried.sum()):,} faint or loose ones",
        "fill the inside": f"{scene.filled:,} points; {scene.further:,} further points on large Gaussians",
        "conditions": "; ".join(roles.names + regions) or "none: it will fall",
        "frame": scene.frame.describe(),
        "grid": f"dx = {simulation.solver.dx:g} m, {simulation.solver.formulation}",
        "wind": f"{wind_words(flow, up)}, before modulations",
    }
    return ["this configuration", *(f"  {name:<16}{text}" for name, text in lines.items())]


def as_plain(value: Any) -> Any:
    """JSON form of a part of a suggestion; a mask becomes its number of Gaussians."""
    if isinstance(value, Region):
        return region_dict(value)
    if isinstance(value, np.ndarray):
        return int(value.sum()) if value.dtype == bool else len(value)
    return vars(value) if is_dataclass(value) else repr(value)


# ---- the configuration


def _aero(s: Suggestion) -> str:
    if s.kind == "flag" and not s.real:
        return """\
aero:
  C_D: 0.1                      # the paper's flags
  C_F: 0.3
  C_L: 0.005
  air_density: 1.225            # kg/m^3
  law: paper
"""
    why = "patches of a captured shell face the wind at every angle"
    if s.natural is not None:
        why = f"a drag of {s.natural.coefficient:.2g} on the silhouette of {s.natural.frontal:.2g} m^2"
    added = ""
    if s.kind == "cloth" and not s.real:
        breadth = sorted(s.size)[1]
        added = f"\n  added_mass: {breadth:<18.3g}# m; breadth of the sheet, which carries air with it"
    return f"""\
aero:
  C_D: {s.drag:<25.4g}# {why}
  C_F: {0.05 * s.drag:<25.4g}
  C_L: 0.0
  air_density: 1.225            # kg/m^3
  law: projected
  drag_step: semi_implicit{added}
"""


def _material(s: Suggestion) -> str:
    if s.real:
        known = known_material(s.material)
        numbers = f"{known.E:.2g} Pa, {known.density:g} kg/m^3, {known.thickness:g} m thick"
        return f"material: {s.material:<22}# {numbers}; others: `gaussian-swaying preview --help`\n"
    kind, why, mass = KINDS[s.kind], "a larger E bends less and needs more substeps", ""
    if s.natural is not None:
        why = f"stiff enough for {s.natural.frequency:.3g} Hz on this grid"
        mass = f", so that {s.natural.mass:.3g} kg move"
    ratio = kind.damping_ratio * (s.natural.frequency if s.natural is not None and not s.by_modes else 1.0)
    return f"""\
material:                       # {s.material}; {kind.words}: {s.kind_reason}
  E: {s.youngs_modulus:<27.6g}# Pa; {why}
  nu: 0.3
  density: {s.density:<21.6g}# kg/m^3
  thickness: {s.thickness:<19.6g}# m; the mass of a patch is density x thickness x area{mass}
  damping_ratio: {ratio:<15.4g}# share of critical damping, without that of the air
"""


def region_dict(region: Region) -> dict[str, Any]:
    """A region as ``class_path`` and ``init_args``, open sides as None."""
    arguments: dict[str, Any]
    if isinstance(region, Box):
        corners = {"min": region.min, "max": region.max}
        arguments = {k: [v if math.isfinite(v) else None for v in corner] for k, corner in corners.items()}
    elif isinstance(region, Cylinder):
        arguments = {"center": list(region.center), "axis": list(region.axis)}
        arguments |= {"radius": region.radius, "height": region.height}
    elif isinstance(region, Not):
        arguments = {"region": region_dict(region.region)}
    elif isinstance(region, Union):
        arguments = {"regions": [region_dict(part) for part in region.regions]}
    else:
        raise TypeError(f"Expected a Box, Cylinder, Not or Union, but got {type(region).__name__}.")
    return {"class_path": type(region).__name__, "init_args": arguments}


def configuration(s: Suggestion, splat: Path, parts: Path, frames: int) -> str:
    """The configuration as text.

    Returns:
        YAML for ``--config`` of a simulation.
    """
    path, region = json.dumps(str(splat.resolve()), ensure_ascii=False), s.moving.region
    where = "null" if region is None else json.dumps(region_dict(region))
    boundaries = " []               # nothing holds it: it will fall"
    if s.pin is not None:
        boundaries = f"""
{_comment("; ".join(s.hold.reasons), 4)}
    - class_path: PinnedRegion
      init_args:
        kind: {_kind(s)}
        region: {json.dumps(region_dict(s.pin))}"""
    elif s.parts is not None:
        boundaries = " []               # what is held is said by scene.parts"
    gravity = "[0.0, 0.0, -9.8]" if s.falls else "[0.0, 0.0, 0.0] "
    why = "for cloth and objects without pins" if s.falls else "it was captured in balance with its weight"
    return f"""\
{_comment(_wind_words(s), 0)}
{_comment(_sway_words(s), 0)}
# Guessed from the splat; every number may be changed. Quality: {s.quality}.
#   {program.command("sim", "--config", "THIS_FILE")}
frames: {frames:<24}# {frames * FRAME_DT:.3g} s at 25 frames a second
frame_dt: {FRAME_DT}                  # s
background: [0.93, 0.94, 0.96]

scene:
  ply: {path}
  up: {_padded(json.dumps([round(c, 6) for c in s.up.direction]), 26)}# scene axes; confidence: {s.up.confidence}
  longest_side: {s.longest_side:<16.6g}# m; the real one, if you know it{_parts(s, parts)}
{_comment(s.moving.reason, 2)}
  region: {where}
  opacity_threshold: {s.moving.opacity_threshold:<11.6g}# fainter Gaussians follow their neighbours and weigh nothing
  faint: carry
  loose: carry                  # and so do specks that hang on nothing or by a thread
  area: open                    # the outer skin; coverage also counts layers and leaves that others hide
  points: grid                  # as many as the grid can use, holes filled; the Gaussians follow its nodes
{_connected(s)}
{_material(s)}
solver:
  formulation: {"modes" if s.by_modes else "total":<17}# {s.why_formulation}
  dx: {s.dx:<26.6g}# m; quality {s.quality}: {s.longest_side / s.dx:.0f} cells along the longest side
  cfl: 0.4{_pivot(s)}
  gravity: {gravity}     # m/s^2, z up; {why}
{_solver_damping(s)}  boundaries:{boundaries}

wind:
  flow: {_padded(json.dumps(list(s.flow)), 24)}# {wind_words(s.flow, s.up.direction)}
  seed: 0
{_gusts(s)}
{_aero(s)}
shader:
  class_path: DiffuseShader
  init_args:
    light: [0.3, -0.6, 1.0]     # direction to the light, z up
    two_sided: true             # the sign of a captured normal has no meaning
    ambient: 0.6
    relative: true              # the colours already contain the light of the photos

camera:
  class_path: OrbitCamera
  init_args:
    width: {PICTURE[0]}
    height: {PICTURE[1]}
    fov_y: 40.0                 # degrees
    azimuth: {s.azimuth:<19.6g}# degrees about up; shows the broad side
    elevation: 8.0
    radius: {s.camera[1]:<20.6g}# times the longest side of the moving part; shows all of the object
    target_offset: {json.dumps(s.camera[0])}  # scene axes, same unit; from the centre of the moving part

recorder:
  trajectory: false             # positions of all particles in each frame
"""


def _wind_words(s: Suggestion) -> str:
    look, speed = LOOKS[s.look], math.hypot(*s.flow)
    other = f", at {speed:.3g} m/s as it was asked for" if abs(speed - look.speed) > 0.01 else ""
    return (
        f"Wind: {s.look} ({look.words}{other}), {speed:.3g} m/s at the object with turbulence of {look.intensity:.0%}, "
        f"{turbulence_length(_middle(s)):.3g} m long. Other looks: --look {', '.join(LOOKS)}."
    )


def _sway_words(s: Suggestion) -> str:
    kind = KINDS[s.kind]
    if s.real or s.natural is None:
        return f"It is taken for {kind.words}: {s.kind_reason}."
    n = s.natural
    still = " There is little to sway." if s.kind == "rigid" else ""
    return (
        f"It is taken for {kind.words}: {s.kind_reason}. First frequency in still air {n.frequency:.3g} Hz, for a "
        f"length of {n.height:.3g} m; mean lean of its top {n.lean:.2%} of its longest side.{still}"
    )


def _pivot(s: Suggestion) -> str:
    if not (s.by_modes and KINDS[s.kind].pivot):
        return ""
    return "\n  pivot: true                   # it sways as easily along as across"


def _middle(s: Suggestion) -> float:
    """Height of its middle above the ground [m]."""
    return 0.5 * s.size[2]


def _gusts(s: Suggestion) -> str:
    length, look = turbulence_length(_middle(s)), LOOKS[s.look]
    return f"""\
  effects:
    - class_path: Turbulence    # von Karman's spectrum; coherent in space, so that parts move out of phase
      init_args: {{intensity: {look.intensity:g}, length: {length:.4g}, cells: {list(CELLS)},
                  start: {[round(s.start * c, 3) + 0.0 for c in s.flow]}}}  # m; a typical stretch of it
"""


def _solver_damping(s: Suggestion) -> str:
    if not s.real:
        return ""
    return f"  damping: {known_material(s.material).damping:<21.3g}# 1/s; losses in air and material\n"


def _kind(s: Suggestion) -> str:
    if s.sheet:
        return "null              # points: a hinge, or a clamp if it is too thick there; `updated` needs nodes"
    return (
        "nodes             # all of the grid in the region, which cannot turn; hinge: points, for the edge of a sheet"
    )


def _parts(s: Suggestion, file: Path) -> str:
    if s.parts is None:
        return ""
    path = json.dumps(str(file), ensure_ascii=False)
    return f", without what is still\n{_comment(s.parts.words(), 2)}\n  parts: {path}"


def _connected(s: Suggestion) -> str:
    return "" if s.connected == "grid" else f"  connected: {s.connected:<19}# leaves closer than a cell move apart\n"


def _padded(text: str, width: int) -> str:
    return f"{text:<{width - 1}} "


def _comment(text: str, indent: int) -> str:
    """Text as comment lines of at most 120 characters."""
    begin = " " * indent + "# "
    return textwrap.fill(text, 120, initial_indent=begin, subsequent_indent=begin, break_long_words=False)
