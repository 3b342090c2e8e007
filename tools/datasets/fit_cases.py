"""The flags and the curtain whose wind and material are to be found from video: cases, truths, configurations.

``make_fit_data.py`` makes the data. Nothing here needs Blender.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from blender_cloth import SPRING_TIME
from flag_reference import FlagPattern, least_quality

LAWS = ("linear", "projected")

FLOWS = {1: (0.95, 1.3, 0.0), 2: (0.85, -1.8, 0.0), 3: (0.65, 2.4, 0.0)}
"""Velocities of the air [m/s]: 1.6, 2.0 and 2.5 m/s at 54, -65 and 75 degrees to a flag at rest, which lies along x."""

MATERIALS = {"a": (3e3, 20.0), "b": (6e3, 30.0)}
"""Young's modulus [Pa] and density [kg/m³], at a thickness of 1 cm."""

START = {"flow": [3.0, 0.5, 0.0], "E": 1.5e3}
"""Where the configurations of all cases start: wrong for each of them."""


@dataclass(frozen=True)
class FitVideo:
    """Settings of the videos of a case.

    Attributes:
        cameras: Their number, 1 to 8.
        size: Width and height [pixels].
        angle: Horizontal field of view [degrees].
        samples: Light paths per pixel.
        read_noise: Standard deviation of the noise of a black pixel, as a share of white.
        shot_noise: Variance of the noise of a white pixel that comes from counting photons.
        quality: Of the JPEG files, 1 to 95.
        light: Direction towards the light, z up.
        ambient: Share of ambient light.
        background: Its colour, 0 to 1.
        threads: Threads to render with; 0 for all.
    """

    cameras: int = 2
    size: tuple[int, int] = (480, 270)
    angle: float = 45.0
    samples: int = 1
    read_noise: float = 0.006
    shot_noise: float = 2e-4
    quality: int = 85
    seed: int = 0
    light: tuple[float, float, float] = (-0.35, -0.8, 0.5)
    ambient: float = 0.45
    background: tuple[float, float, float] = (0.46, 0.58, 0.72)
    threads: int = 1

    def __post_init__(self) -> None:
        """Check the fields."""
        for name, low, high in (("cameras", 1, 8), ("samples", 1, 4096), ("quality", 1, 95), ("threads", 0, 1024)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"Expected `{name}` from {low} to {high}, but got {getattr(self, name)}.")
        for name in ("read_noise", "shot_noise"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"Expected `{name}` of at least 0 and below 1, but got {getattr(self, name)}.")
        if min(self.size) < 16:
            raise ValueError(f"Expected `size` of at least 16 x 16 pixels, but got {self.size[0]} x {self.size[1]}.")


def flag(flow: tuple[float, float, float], material: str) -> FlagPattern:
    """A flag that hangs by its upper edge in a flow [m/s], of one of :data:`MATERIALS`."""
    stiffness, density = MATERIALS[material]
    return FlagPattern(
        stiffness,
        0.3,
        density,
        flow,
        "top",
        texture="printed",
        paper_drag=None,
        width=1.0,
        height=0.7,
        ripple=0.003,
        cells=100,
        frames=97,
        fps=24,
    )


CASES: dict[str, FlagPattern] = {
    **{f"flag_wind{wind}_{material}": flag(FLOWS[wind], material) for material in MATERIALS for wind in FLOWS},
    "curtain": replace(flag((1.0, 1.5, 0.0), "a"), youngs_modulus=4e3, density=25.0, height=1.2, cells=60),
    **{
        f"pole_wind{number}": replace(flag(flow, "b"), density=20.0, pinned="left", cells=60)
        for number, flow in enumerate([(1.6, 1.4, 0.0), (4.5, 2.2, 0.0)], 1)
    },
}
"""Flags that hang by their upper edge, three winds on two materials; a curtain; and two flags on a pole.

The flags on a pole fold up as they fall and then flap, and small differences grow. No two solvers, or meshes of one,
agree for long (docs/fit_data.md). The others are repeatable: they swing up and are then nearly steady."""


def case_of(name: str, cells: int | None = None, frames: int | None = None) -> FlagPattern:
    """A case, with another mesh or number of frames on request, and the solver steps that its mesh needs."""
    pattern = CASES[name]
    pattern = replace(pattern, cells=cells or pattern.cells, frames=frames or pattern.frames)
    return replace(pattern, quality=least_quality(pattern))


def shared_truth(pattern: Any, video: FitVideo) -> dict[str, Any]:
    """What ``truth.json`` says of a flag (``FlagPattern``) and of a soft post (``SoftPattern``) alike."""
    x, y, _ = pattern.flow
    seconds = (pattern.frames - 1) / pattern.fps
    return {
        "flow": list(pattern.flow),
        "speed": math.hypot(*pattern.flow),
        "azimuth": math.degrees(math.atan2(y, x)),
        "elevation": 0.0,
        "E": pattern.youngs_modulus,
        "density": pattern.density,
        "C_D": pattern.drag,
        "C_F": 0.0,
        "C_L": 0.0,
        "air_density": pattern.air_density,
        "damping": pattern.damping,
        "gravity": [0.0, 0.0, -pattern.gravity],
        "fps": pattern.fps,
        "seconds": seconds,
        "fit_until": 0.5 * seconds,
        "units": "m, s, kg, degrees from +x towards +y",
        "video": asdict(video),
    }


def shared_scene(pattern: Any, video: FitVideo, law: str, folder: str) -> dict[str, Any]:
    """What configurations of a flag (``FlagPattern``) and of a soft post (``SoftPattern``) have in common."""
    shader = {"light": list(video.light), "two_sided": True, "ambient": video.ambient}
    return {
        "frames": pattern.frames,
        "frame_dt": 1 / pattern.fps,
        "background": list(video.background),
        "wind": {"flow": START["flow"], "modulations": []},
        "aero": {"C_D": pattern.drag, "C_F": 0.0, "C_L": 0.0, "air_density": pattern.air_density, "law": law},
        "shader": {"class_path": "DiffuseShader", "init_args": shader},
        "camera": {"class_path": "CaptureCamera", "init_args": {"path": f"{folder}/transforms.json", "view": 0}},
    }


def truth_fields(pattern: FlagPattern, video: FitVideo) -> dict[str, Any]:
    """What ``truth.json`` says: the wind, the material, and what else a simulation needs to be comparable."""
    return shared_truth(pattern, video) | {
        "nu": 1 / 3,
        "thickness": pattern.thickness,
        "areal_density": pattern.density * pattern.thickness,
        "membrane_stiffness": pattern.youngs_modulus * pattern.thickness,
        "bending_stiffness": pattern.material().bending,
        "law": "linear",
        "stiffness_damping": SPRING_TIME,
        "cells": pattern.cells,
        "held": f"the {pattern.pinned} edge, a line of points that is free to turn",
        "solver": "Blender's cloth; see docs/fit_data.md for what matches",
    }


def scene_settings(
    pattern: FlagPattern, video: FitVideo, law: str, folder: str, spacing: float = 0.005
) -> dict[str, Any]:
    """A configuration of ``gaussian-swaying sim`` for a case, with wrong values for what is sought.

    Units: ``spacing`` [m].
    """
    height = pattern.height
    edge: dict[str, Any] = {"min": [None, None, None], "max": [round(1.1 * spacing, 6), None, None]}
    if pattern.pinned == "top":
        rows = round(height / spacing) + 1
        spacing = height / (rows - 0.5)
        edge = {"min": [None, None, round(height - 0.3 * spacing, 6)], "max": [None, None, None]}
        height = rows * spacing
    held = {"class_path": "Box", "init_args": edge}
    return shared_scene(pattern, video, law, folder) | {
        "scene": {
            "generator": {
                "class_path": "FlagScene",
                "init_args": {
                    "width": pattern.width,
                    "height": height,
                    "spacing": spacing,
                    "overlap": 0.4,
                    "ripple": pattern.ripple,
                    "pattern": "printed",
                    "yaw": pattern.yaw,
                },
            },
            "metres_per_unit": 1.0,
            "area": "coverage",
            "layers": 3,
            "max_stretch": None,
        },
        "material": {
            "E": START["E"],
            "nu": 0.3,
            "density": pattern.density,
            "thickness": pattern.thickness,
            "law": "SpringNetwork",
        },
        "solver": {
            "formulation": "total",
            "dx": 0.04,
            "cfl": 0.4,
            "gravity": [0.0, 0.0, -pattern.gravity],
            "damping": pattern.damping,
            "stiffness_damping": SPRING_TIME,
            "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": None, "region": held}}],
        },
    }


def fit_settings(folder: str) -> dict[str, Any]:
    """A configuration of ``gaussian-swaying fit`` for the case in a folder: what is sought, from half of the video."""
    return {
        "base": [f"{folder}/scene.yaml"],
        "videos": [folder],
        "unknowns": {
            "wind.speed": {"range": [0.5, 10.0]},
            "wind.azimuth": {"range": [-90.0, 90.0]},
            "material.E": {"range": [1e3, 2e4]},
        },
    }
