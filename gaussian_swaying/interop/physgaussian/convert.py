"""PhysGaussian's JSON configurations as settings of this package, key by key.

``docs/physgaussian.md`` lists what each key becomes, and what it means in PhysGaussian and here.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_frames, check_vector
from gaussian_swaying._inputs import read_json
from gaussian_swaying.interop.physgaussian.boundaries import Turned, boundary_settings
from gaussian_swaying.interop.physgaussian.camera_settings import camera_settings
from gaussian_swaying.interop.physgaussian.fields import Fields, Notes
from gaussian_swaying.interop.physgaussian.filling import filling_settings
from gaussian_swaying.interop.physgaussian.materials import material_settings
from gaussian_swaying.interop.physgaussian.parts import box
from gaussian_swaying.interop.physgaussian.space import heading, rotation_matrix, tidy, up_direction


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

    Raises:
        ValueError: If a key is unknown, missing, out of range or not supported; the message names it.
        TypeError: If a value has the wrong type.
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
    return settings, notes.sentences


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


__all__ = ["convert", "read_config"]
