"""The results of the preview as plain numbers, for preview.json."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from gaussian_swaying.preview.cost import Cost
from gaussian_swaying.preview.picture import classify, conditions, mean_flow
from gaussian_swaying.preview.starter import region_dict
from gaussian_swaying.preview.suggest import Suggestion
from gaussian_swaying.simulation.simulation import Simulation


def suggestion_dict(found: Suggestion) -> dict[str, Any]:
    """A suggestion without its masks."""
    region = found.region.region()
    return {
        "up": {
            "direction": list(found.up.direction),
            "confidence": found.up.confidence,
            "scores": found.up.scores,
            "reasons": found.up.reasons,
            "floor_gaussians": int(found.up.ground.sum()),
        },
        "region": {
            "region": None if region is None else region_dict(region),
            "simulated": int(found.region.simulated.sum()),
            "opacity_threshold": found.region.opacity_threshold,
            "specks": found.region.specks,
            "reason": found.region.reason,
        },
        "hold": asdict(found.hold) | {"region": None if found.pin is None else region_dict(found.pin)},
        "longest_side_m": found.longest_side,
        "metres_per_unit": found.metres_per_unit,
        "size_m": list(found.size),
        "spacing_m": found.spacing,
        "dx_m": found.dx,
        "quality": found.quality,
        "sheet": found.sheet,
        "azimuth": found.azimuth,
        "flow": list(found.flow),
        "youngs_modulus_Pa": found.youngs_modulus,
        "thickness_m": found.thickness,
        "stiffness_reason": found.stiffness_reason,
    }


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
    }


def cost_dict(cost: Cost) -> dict[str, Any]:
    """A cost with its total."""
    return asdict(cost) | {"total_seconds": cost.total_seconds}
