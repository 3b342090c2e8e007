"""The length of a scene unit as an unknown, which gravity tells if something sags, falls or swings.

A variant with another length is simulated on the same grid, in a metre of its own. With a scene unit that is r times as
long, the same motion in scene units has 1/r of the wind and of gravity. A sheet of the same mass of an area has 1/r of
the density and 1/r³ of E then, and a filled body 1/r² of E. The breadth of ``aero.added_mass`` is a length: 1/r.
"""

from __future__ import annotations

from dataclasses import replace

from gaussian_swaying._fixed import changed
from gaussian_swaying.simulation.model import Model
from gaussian_swaying.wind.field import WindField

SCALE = "scene.metres_per_unit"


def at_scale(model: Model, metres_per_unit: float) -> Model:
    """A model that moves as if a scene unit had another length.

    Args:
        model: With the values that are meant in metres.
        metres_per_unit: The length of a scene unit [m].
    """
    wind, scene = model.wind, model.scene
    gravity, sheet = model.value("solver.gravity"), not scene.filled
    if not any(gravity):
        raise ValueError(f"Without gravity nothing tells `{SCALE}`: set `solver.gravity`, or measure a length.")
    if not isinstance(wind, WindField) or len(wind.modulations) or len(wind.effects) or model.air or model.forces:
        raise ValueError(
            f"`{SCALE}` can be sought only in a plain wind: remove `wind.modulations`, `wind.effects`, `air` and "
            "`forces`, or measure a length."
        )
    if model.material.volume != "patch" or model.points.count != scene.on_surface + scene.filled:
        raise ValueError(
            f"`{SCALE}` can be sought only with `material.volume: patch` and `scene.layers: 1`: set them, or measure a "
            "length."
        )
    if model.points.bending is not None and (isinstance(model.material.bending, str) or model.material.regions):
        raise ValueError(
            f"`{SCALE}` can be sought only with one `material.bending` in N m: give it as a number and without parts, "
            "or measure a length."
        )
    ratio = metres_per_unit / scene.frame.metres_per_unit
    changes = {"material.E": model.value("material.E") / ratio ** (3 if sheet else 2)}
    if sheet:
        changes["material.density"] = model.value("material.density") / ratio
    found = model.at(changes | {"solver.gravity": [part / ratio for part in gravity]})
    if model.points.bending is not None:
        found = found.replace(points=replace(found.points, bending=model.points.bending / ratio**5))
    if model.aero.added_mass:
        found = replace(found, aero=changed(model.aero, added_mass=model.aero.added_mass / ratio))
    return replace(found, wind=changed(wind, flows=wind.flows / ratio))
