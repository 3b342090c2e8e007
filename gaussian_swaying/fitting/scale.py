"""The length of a scene unit as an unknown, which gravity tells if something sags, falls or swings.

A variant with another length is simulated on the same grid, in a metre of its own. With a scene unit that is r times as
long, the same motion in scene units has 1/r of the wind and of gravity. A sheet of the same mass of an area has 1/r of
the density and 1/r³ of E then, and a filled body 1/r² of E. The breadth of ``aero.added_mass`` is a length: 1/r.
"""

from __future__ import annotations

from dataclasses import replace

from gaussian_swaying._fixed import changed
from gaussian_swaying.simulation.model import Setup, value_of, with_values
from gaussian_swaying.wind.field import WindField

SCALE = "scene.metres_per_unit"


def at_scale(setup: Setup, metres_per_unit: float) -> Setup:
    """A setup that moves as if a scene unit had another length.

    Args:
        setup: With the values that are meant in metres.
        metres_per_unit: The length of a scene unit [m].
    """
    wind, scene = setup.wind, setup.scene
    gravity, sheet = value_of(setup, "solver.gravity"), not scene.filled
    if not any(gravity):
        raise ValueError(f"Without gravity nothing tells `{SCALE}`: set `solver.gravity`, or measure a length.")
    if not isinstance(wind, WindField) or len(wind.modulations) or len(wind.effects) or setup.air or setup.forces:
        raise ValueError(
            f"`{SCALE}` can be sought only in a plain wind: remove `wind.modulations`, `wind.effects`, `air` and "
            "`forces`, or measure a length."
        )
    if setup.material.volume != "patch" or setup.points.count != scene.on_surface + scene.filled:
        raise ValueError(
            f"`{SCALE}` can be sought only with `material.volume: patch` and `scene.layers: 1`: set them, or measure a "
            "length."
        )
    if setup.points.bending is not None and (isinstance(setup.material.bending, str) or setup.material.regions):
        raise ValueError(
            f"`{SCALE}` can be sought only with one `material.bending` in N m: give it as a number and without parts, "
            "or measure a length."
        )
    ratio = metres_per_unit / scene.frame.metres_per_unit
    changes = {"material.E": value_of(setup, "material.E") / ratio ** (3 if sheet else 2)}
    if sheet:
        changes["material.density"] = value_of(setup, "material.density") / ratio
    found = with_values(setup, changes | {"solver.gravity": [part / ratio for part in gravity]})
    if setup.points.bending is not None:
        found = replace(found, points=replace(found.points, bending=setup.points.bending / ratio**5))
    if setup.aero.added_mass:
        found = replace(found, aero=changed(setup.aero, added_mass=setup.aero.added_mass / ratio))
    return replace(found, wind=changed(wind, flows=wind.flows / ratio))
