"""The filling of a PhysGaussian configuration: ``scene.filling``."""

from __future__ import annotations

from typing import Any

from gaussian_swaying.interop.physgaussian.fields import Fields, Notes

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


__all__ = ["filling_settings"]
