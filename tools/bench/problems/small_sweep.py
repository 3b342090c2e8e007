"""A sweep of tiny flags, which takes seconds: options and axes for the configuration ``flag``."""

from typing import Any

_POLE = {"class_path": "Box", "init_args": {"min": [None, None, None], "max": [0.11, None, None]}}

SETTINGS: dict[str, Any] = {
    "frames": 12,
    "scene.generator.init_args.spacing": 0.1,
    "solver.dx": 0.2,
    "solver.boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": _POLE}}],
    "camera.init_args.width": 32,
    "camera.init_args.height": 18,
}
"""Options of all runs."""
AXES: dict[str, Any] = {
    "wind.flow": [[4.0, 1.0, 0.0], [8.0, 2.0, 0.0]],
    "material.E": {"from": 3e3, "to": 3e4, "count": 2, "scale": "log"},
    "wind.seed": {"draw": "integer", "low": 0, "high": 10**6},
}
"""Four runs for each draw."""

__all__ = ["AXES", "SETTINGS"]
