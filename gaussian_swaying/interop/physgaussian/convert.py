"""PhysGaussian's JSON configurations as settings of this package, key by key.

``docs/physgaussian.md`` lists what each key becomes, and what it means in PhysGaussian and here.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_frames, check_vector
from gaussian_swaying._inputs import read_json
from gaussian_swaying.interop.physgaussian.boundaries import Turned, boundary_settings
from gaussian_swaying.interop.physgaussian.fields import Fields, Notes, box, part
from gaussian_swaying.interop.physgaussian.materials import material_settings
from gaussian_swaying.interop.physgaussian.space import CENTER, heading, rotation_matrix, tidy, up_direction


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a PhysGaussian configuration; ValueError if it is missing or not a JSON object."""
    config = read_json(path, "PhysGaussian configuration")
    if not isinstance(config, dict):
        raise ValueError(f"The PhysGaussian configuration `{path}` is not a JSON object: use one of its config/*.json.")
    return config


def convert(
    config: Mapping[str, Any], cameras: str | None = None, sticky_planes: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Settings of a simulation for a PhysGaussian configuration.

    Numbers stay as in the file: boxes and planes are in the normalised space (``normalisation``), which is mapped
    to the scene once its splat is known. Vectors are rotated with :func:`heading`.

    Args:
        config: The JSON object.
        cameras: ``cameras.json`` of the 3DGS model, for ``default_camera_index`` and the lens.
        sticky_planes: Make every plane sticky, as PhysGaussian's code does whatever ``surface`` says.

    Returns:
        The settings, without a splat (``scene.ply`` must be set), and sentences about everything whose meaning differs.
    """
    take, notes = Fields(config, "PhysGaussian's configuration"), Notes()
    degrees = take.numbers("rotation_degree", [])
    axes = take.list("rotation_axis", [])
    rotation, scale = rotation_matrix(degrees, axes), take.positive("scale", 1.0)
    turn = heading(rotation)

    grid_lim, n_grid = take.positive("grid_lim", 2.0), take.whole("n_grid", 50)
    dx = grid_lim / n_grid
    substep, frame_dt = take.positive("substep_dt", 1e-4), take.positive("frame_dt", 1e-2)
    frames = check_frames("frame_num", take.whole("frame_num", 100))
    notes.add(
        f"`substep_dt`: the substep is adaptive instead of {substep:g} s, which is only used for damping and impulses; "
        f"--solver.substep {substep:g} fixes it, and is refused unless it is stable."
    )

    scene: dict[str, Any] = {
        "ply": None,
        "up": up_direction(rotation),
        "opacity_threshold": take.number("opacity_threshold", 0.02),
        "faint": "drop",
    }
    area = take.get("sim_area", None)
    if area is not None:
        bounds = check_vector("sim_area", area, 6)
        scene["region"] = box(bounds[0::2], bounds[1::2])
    filling = take.get("particle_filling", None)
    if filling is not None:
        scene["filling"] = filling_settings(filling, n_grid, grid_lim, notes)

    material = material_settings(take, notes)
    solver: dict[str, Any] = {
        "formulation": "updated",
        "dx": dx,
        "gravity": _gravity(take, turn),
        "damping": _damping(take, substep, notes),
    }
    entries = take.list("boundary_conditions", [])
    solver["boundaries"] = [
        made
        for k, entry in enumerate(entries)
        for made in boundary_settings(k, entry, Turned(turn, dx, grid_lim, substep), sticky_planes, notes)
    ]
    camera = camera_settings(take, cameras, notes)
    take.finish()
    settings = {
        "frames": frames + 1,
        "frame_dt": frame_dt,
        "normalisation": {"rotation_degree": degrees, "rotation_axis": axes, "scale": scale},
        "scene": scene,
        "material": material,
        "solver": solver,
        "wind": {"flow": [0.0, 0.0, 0.0]},
        "aero": {"C_D": 0.0, "C_F": 0.0, "C_L": 0.0},
        "camera": camera,
    }
    notes.add(
        "PhysGaussian has no wind: the coefficients of `aero` are zero; for wind set `wind.flow` and C_D, C_F and C_L."
    )
    return settings, notes


def _gravity(take: Fields, turn: Tensor) -> list[float]:
    """``solver.gravity`` [m/s²]."""
    value = take.get("g", 9.8)
    if not isinstance(value, (list, tuple)):
        raise ValueError(
            f"Expected `g` to be a list of 3 numbers, for example [0, 0, -9.8], but got {value!r}; PhysGaussian's "
            "default, a single number, does not work there either."
        )
    return tidy(turn @ torch.tensor(check_vector("g", value), dtype=torch.float64))


def _damping(take: Fields, substep: float, notes: Notes) -> float:
    """Decay rate [1/s] of the factor by which velocities are multiplied every substep."""
    rpic = take.number("rpic_damping", 0.0)
    if rpic != 0:
        notes.add(
            f"`rpic_damping` {rpic:g} is not supported: the transfer is APIC; for damping use --solver.damping and "
            "--solver.stiffness_damping."
        )
    if take.given("pic_damping"):
        take.number("pic_damping")
        notes.add("`pic_damping` has no effect in PhysGaussian or here.")
    factor = take.positive("grid_v_damping_scale", 1.1)
    return 0.0 if factor >= 1 else -math.log(factor) / substep


_FILLING_NOTES = {
    "density_threshold": "has another definition here, so `scene.filling.threshold` keeps its default.",
    "search_threshold": "is not needed: cells are enclosed by the vote of 26 rays (`scene.filling.votes`).",
    "search_exclude_direction": "is not supported: rays go in all directions, and an open side is outvoted.",
    "ray_cast_direction": "is not supported: all rays count crossings, not one.",
    "max_particles_num": "is not supported: the number of points follows from the volume.",
    "boundary": "is not supported: everything enclosed is filled, within `scene.region`.",
    "smooth": "is not supported: the density is blurred by half a cell.",
    "visualize": "is not supported: filled points are never drawn.",
}


def filling_settings(fields: Any, n_grid: int, grid_lim: float, notes: Notes) -> dict[str, Any]:
    """``scene.filling``: another method for the same purpose, on a grid with the same spacing."""
    take = Fields(fields, "particle_filling")
    spacing = grid_lim / take.whole("n_grid", 4 * n_grid)
    wanted = take.whole("max_partciels_per_cell", 1)
    count = next((n for n in (1, 8) if wanted <= n), 27)
    if count != wanted:
        notes.add(f"`particle_filling.max_partciels_per_cell` {wanted} becomes {count}, as a cell has 1, 8 or 27.")
    for name, sentence in _FILLING_NOTES.items():
        value = take.get(name, None)
        if value is not None and value is not False:
            notes.add(f"`particle_filling.{name}` {sentence}")
    take.finish()
    return {"spacing": spacing, "particles_per_cell": count}


def camera_settings(take: Fields, cameras: str | None, notes: Notes) -> dict[str, Any]:
    """``camera``: a camera of the model, the moving camera, or our orbit camera if the file of cameras is missing."""
    viewpoint = list(take.vector("mpm_space_viewpoint_center", CENTER))
    up = list(take.vector("mpm_space_vertical_upward_axis", (0.0, 0.0, 1.0)))
    index = take.whole("default_camera_index", 0, least=-1)
    names = ("init_azimuthm", "init_elevation", "init_radius")
    start = {name: take.get(name, None) for name in names}
    deltas = {name: take.get(name, None) for name in ("delta_a", "delta_e", "delta_r")}
    moves = take.flag("move_camera", False)
    if take.flag("show_hint", False):
        notes.add("`show_hint` has no effect: PhysGaussian prints the camera's angles and stops.")
    orbit = "gaussian_swaying.interop.physgaussian.camera.PhysGaussianCamera"
    if index >= 0 and cameras is None:
        notes.add(
            f"`default_camera_index` {index} is a camera of the 3DGS model, whose cameras.json was not given, so it is "
            f"an orbit here; --camera {orbit} --camera.cameras PATH --camera.index {index} uses the model's."
        )
        return part("OrbitCamera", width=960, height=540)
    if index >= 0:
        return part(orbit, cameras=cameras, index=index)
    wanted = [*start, *deltas] if moves else list(start)
    for name in wanted:
        if (start | deltas)[name] is None:
            raise ValueError(f"The key `{name}` is missing, but `default_camera_index` -1 needs it.")
        take.number(name)
    if cameras is None:
        notes.add(
            "`default_camera_index` -1: PhysGaussian takes lens and size of the picture from the model's cameras.json; "
            "here they are those of `camera`."
        )
    change = [float(d) for d in deltas.values()] if moves else [0.0] * 3
    return part(
        orbit,
        cameras=cameras,
        azimuth=float(start["init_azimuthm"]),
        elevation=float(start["init_elevation"]),
        radius=float(start["init_radius"]),
        delta_azimuth=change[0],
        delta_elevation=change[1],
        delta_radius=change[2],
        viewpoint=viewpoint,
        up=up,
    )


def to_yaml(settings: Mapping[str, Any], notes: Iterable[str] = (), source: str | None = None) -> str:
    """Settings as a YAML file for ``--config``, with the notes as comments at the top.

    Args:
        settings: From :func:`convert`.
        notes: From :func:`convert`.
        source: Name of the file that was converted.

    Returns:
        The text.
    """
    import textwrap

    import yaml

    head = [f"PhysGaussian's {source or 'configuration'}, converted. Give the splat with --scene.ply PATH.", *notes]
    width = {"width": 118, "break_long_words": False, "break_on_hyphens": False}
    lines = [
        line
        for text in head
        for line in textwrap.wrap(text, initial_indent="# ", subsequent_indent="#   ", **width)  # type: ignore[arg-type]
    ]
    plain = json.loads(json.dumps(settings))  # copies, since YAML would write repeated parts as references
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120)
    return "\n".join(lines) + "\n" + body
