"""The parts of a splat in a simulation: materials of their own, bodies for what is rigid, a pin for what is held."""

from __future__ import annotations

import dataclasses

from gaussian_swaying._fixed import FixedList, changed
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.parts import NUMBERS, PartRegion
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.pins import PinnedRegion, RigidRegion
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.simulation.material import Material, MaterialRegion
from gaussian_swaying.simulation.scene import Scene


def with_parts(scene: Scene, cloud: GaussianCloud, material: Material, solver: Solver) -> tuple[Material, Solver]:
    """Material and solver with what the parts of a scene add to them; both stay as they are if it has none.

    Args:
        scene: The scene, all in scene units.
        cloud: Its Gaussians.
        material: Its ``regions`` come after those of the parts, and win.
        solver: Gets a body for each part that is rigid, and a pin for all that are held, which holds nodes of the grid.

    Returns:
        Copies.
    """
    parts = scene.parts
    if parts is None:
        return material, solver
    chosen = scene.select(cloud)
    means, labels = cloud.means[chosen], parts.labels[chosen]
    regions = [
        MaterialRegion(PartRegion(part.name, means, labels == k), **{name: getattr(part, name) for name in NUMBERS})
        for k, part in enumerate(parts.parts)
        if part.has_material and bool((labels == k).any())
    ]
    acting: list[Boundary] = [
        RigidRegion(PartRegion(part.name, means, labels == k))
        for k, part in enumerate(parts.parts)
        if part.role == "rigid" and bool((labels == k).any())
    ]
    held = parts.mask(role="held")[chosen]
    if regions:
        material = dataclasses.replace(material, regions=[*regions, *material.regions])
    if bool(held.any()):
        names = [part.name for k, part in enumerate(parts.parts) if part.role == "held" and bool((labels == k).any())]
        acting.append(PinnedRegion(PartRegion(", ".join(names), means, held), "nodes"))
    if acting:
        solver = changed(solver, boundaries=FixedList([*solver.boundaries, *acting]))
    return material, solver
