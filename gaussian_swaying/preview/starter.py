"""A first configuration as a YAML file with comments, from the results of the preview."""

from __future__ import annotations

import json
import math
import textwrap
from pathlib import Path
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying.geometry.regions import Box, Cylinder, Not, Region, Union
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.preview.kinds import KINDS
from gaussian_swaying.preview.suggest import Suggestion
from gaussian_swaying.preview.up import wind_words
from gaussian_swaying.wind.turbulence import CELLS, LOOKS, turbulence_length

PICTURE = (960, 540)
FRAME_DT = 0.04  # s


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


def starter_yaml(suggestion: Suggestion, ply: str | Path, frames: int = 250) -> str:
    """The configuration as text.

    Args:
        suggestion: From :func:`~gaussian_swaying.preview.suggest`.
        ply: The splat; its absolute path is written.
        frames: Number of frames.

    Returns:
        YAML for ``--config`` of a simulation.
    """
    s = suggestion
    path = json.dumps(str(Path(ply).resolve()), ensure_ascii=False)
    region = s.region.region()
    where = "null" if region is None else json.dumps(region_dict(region))
    boundaries = " []               # nothing holds it: it will fall"
    if s.pin is not None:
        boundaries = f"""
{_comment(s.hold.reason, 4)}
    - class_path: PinnedRegion
      init_args:
        kind: {_kind(s)}
        region: {json.dumps(region_dict(s.pin))}"""
    elif s.parts is not None:
        boundaries = " []               # what is held is said by scene.parts"
    falls = KINDS[s.kind].cloth or not s.fixed
    gravity = "[0.0, 0.0, -9.8]" if falls else "[0.0, 0.0, 0.0] "
    why = "for cloth and objects without pins" if falls else "it was captured in balance with its weight"
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
  longest_side: {s.longest_side:<16.6g}# m; the real one, if you know it{_parts(s)}
{_comment(s.region.reason, 2)}
  region: {where}
  opacity_threshold: {s.region.opacity_threshold:<11.6g}# fainter Gaussians follow their neighbours and weigh nothing
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
    radius: {s.camera_radius:<20.6g}# times the longest side of the moving part; shows all of the object
    target_offset: {json.dumps(list(s.camera_offset))}  # scene axes, same unit; from the centre of the moving part

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
    """Return the kind of a pin, with the reason as a comment: that of its shape for a sheet, nodes else."""
    if s.sheet:
        return "null              # points: a hinge, or a clamp if it is too thick there; `updated` needs nodes"
    return (
        "nodes             # all of the grid in the region, which cannot turn; hinge: points, for the edge of a sheet"
    )


def _parts(s: Suggestion) -> str:
    if s.parts is None:
        return ""
    path = json.dumps(s.parts.path, ensure_ascii=False)
    return f", without what is still\n{_comment(s.parts.words(), 2)}\n  parts: {path}"


def _connected(s: Suggestion) -> str:
    return "" if s.connected == "grid" else f"  connected: {s.connected:<19}# leaves closer than a cell move apart\n"


def _padded(text: str, width: int) -> str:
    """Text padded with blanks to a width, with at least one blank."""
    return f"{text:<{width - 1}} "


def _comment(text: str, indent: int) -> str:
    """Text as comment lines of at most 120 characters."""
    begin = " " * indent + "# "
    return textwrap.fill(text, 120, initial_indent=begin, subsequent_indent=begin, break_long_words=False)
