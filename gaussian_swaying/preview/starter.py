"""A first configuration as a YAML file with comments, from the results of the preview."""

from __future__ import annotations

import json
import math
import shlex
import textwrap
from pathlib import Path
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying.geometry.regions import Box, Cylinder, Not, Region, Union
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.preview.suggest import Suggestion, at_quality
from gaussian_swaying.preview.up import wind_words

DRAFT_FRAMES = 51  # 2 s
DRAFT_PICTURE = (480, 270)
STARTER_PICTURE = (960, 540)
_CLOTH_AERO = """\
aero:
  C_D: 0.1                      # the paper's flags
  C_F: 0.3
  C_L: 0.005
  air_density: 1.225            # kg/m^3
  law: paper
"""


_SHELL_AERO = """\
aero:
  C_D: 0.5                      # the paper's captures
  C_F: 0.4
  C_L: 0.01
  air_density: 1.225            # kg/m^3
  law: projected                # patches of a captured shell face the wind at every angle
"""


def _material(s: Suggestion) -> str:
    if s.real:
        known = known_material(s.material)
        numbers = f"{known.E:.2g} Pa, {known.density:g} kg/m^3, {known.thickness:g} m thick"
        return f"material: {s.material:<22}# {numbers}; others: `gaussian-swaying preview --help`\n"
    density, why = (400.0, "lighter objects follow the gusts faster")
    if s.sheet:
        density, why = (30.0, "the paper's flags, whose E is 3e3 to 6e3")
    return f"""\
material:
  name: {s.material:<24}# a guess; `material: {s.material}` alone takes its own numbers, stiffer than those below
  # {s.stiffness_reason}
  E: {s.youngs_modulus:<27.1e}# Pa; a larger E bends less and needs more substeps
  nu: 0.3
  density: {density:<21}# kg/m^3; {why}
  thickness: {s.thickness:<19.4g}# m; a shell; the mass of a patch is density x thickness x area
"""


def region_dict(region: Region) -> dict[str, Any]:
    """A region as ``class_path`` and ``init_args``, open sides as None.

    Raises:
        TypeError: If it is not a Box, Cylinder, Not or Union.
    """
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


def draft_yaml(suggestion: Suggestion, ply: str | Path) -> str:
    """A configuration for a first look: like :func:`starter_yaml`, of quality draft, with 2 s and a small picture."""
    title = "# A first look: 2 s, a small picture. Quality: draft."
    return _yaml(at_quality(suggestion, "draft"), ply, DRAFT_FRAMES, DRAFT_PICTURE, title)


def starter_yaml(suggestion: Suggestion, ply: str | Path, frames: int = 250) -> str:
    """The configuration as text.

    Args:
        suggestion: From :func:`~gaussian_swaying.preview.suggest`.
        ply: The splat; its absolute path is written.
        frames: Number of frames.

    Returns:
        YAML for ``--config`` of a simulation.
    """
    title = f"# A first configuration. Quality: {suggestion.quality}."
    return _yaml(suggestion, ply, frames, STARTER_PICTURE, title)


def _yaml(suggestion: Suggestion, ply: str | Path, frames: int, size: tuple[int, int], title: str) -> str:
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
    falls = s.sheet or not s.fixed
    gravity = "[0.0, 0.0, -9.8]" if falls else "[0.0, 0.0, 0.0] "
    why = "for cloth and objects without pins" if falls else "it was captured in balance with its weight"
    return f"""\
{title}
# Guessed from the splat; every number may be changed.{_chosen(s)}
#   {shlex.join(program.words("sim"))} --config THIS_FILE
frames: {frames:<24}# {frames * 0.04:.3g} s at 25 frames a second
frame_dt: 0.04                  # s
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
  formulation: total            # particles keep their neighbours: cannot tear
  dx: {s.dx:<26.6g}# m; quality {s.quality}: {s.longest_side / s.dx:.0f} cells along the longest side
  cfl: 0.4
  gravity: {gravity}     # m/s^2, z up; {why}
  damping: {_damping(s):<21.3g}# 1/s; losses in air and material
  boundaries:{boundaries}

wind:
  flow: {_padded(json.dumps(list(s.flow)), 24)}# {wind_words(s.flow, s.up.direction)}
  seed: 0
  modulations:
    - class_path: SineSway
      init_args: {{amplitude: 0.5, period: 2.0}}
    - class_path: GaussianGust
      init_args: {{std: 0.3}}

{_CLOTH_AERO if s.sheet else _SHELL_AERO}
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
    width: {size[0]}
    height: {size[1]}
    fov_y: 40.0                 # degrees
    azimuth: {s.azimuth:<19.6g}# degrees about up; shows the broad side
    elevation: 8.0
    radius: {s.camera_radius:<20.6g}# times the longest side of the moving part; shows all of the object
    target_offset: {json.dumps(list(s.camera_offset))}  # scene axes, same unit; from the centre of the moving part

recorder:
  trajectory: false             # positions of all particles in each frame
"""


def _chosen(s: Suggestion) -> str:
    """The end of the first comment: why the material has its numbers."""
    if s.real:
        return ""
    return " A splat does not show its material: E and thickness are chosen\n# so that it sways visibly in this wind."


def _damping(s: Suggestion) -> float:
    """Decay rate of motion [1/s]."""
    return known_material(s.material).damping if s.real else 0.2 if s.sheet else 1.0


def _kind(s: Suggestion) -> str:
    """Return the kind of a pin, with the reason as a comment: hinge for a sheet, whose edge can turn, nodes else."""
    if s.sheet:
        return "hinge             # points: cloth turns where it is held; `updated` needs nodes"
    return (
        "nodes             # all of the grid in the region, which cannot turn; hinge: points, for the edge of a sheet"
    )


def _parts(s: Suggestion) -> str:
    """The line that names the file of the parts, if there are any."""
    if s.parts is None:
        return ""
    path = json.dumps(s.parts.path, ensure_ascii=False)
    return f", without what is still\n{_comment(s.parts.words(), 2)}\n  parts: {path}"


def _connected(s: Suggestion) -> str:
    """The line of ``scene.connected``, if it is not the default."""
    return "" if s.connected == "grid" else f"  connected: {s.connected:<19}# leaves closer than a cell move apart\n"


def _padded(text: str, width: int) -> str:
    """Text padded with blanks to a width, with at least one blank."""
    return f"{text:<{width - 1}} "


def _comment(text: str, indent: int) -> str:
    """Text as comment lines of at most 120 characters."""
    begin = " " * indent + "# "
    return textwrap.fill(text, 120, initial_indent=begin, subsequent_indent=begin, break_long_words=False)
