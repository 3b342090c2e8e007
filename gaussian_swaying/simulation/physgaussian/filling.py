"""The filling of a PhysGaussian configuration: ``scene.filling``."""

from __future__ import annotations

from typing import Any

from gaussian_swaying.simulation.physgaussian.fields import Fields, Notes

_FILLING_NOTES = {
    "density_threshold": "is counted otherwise here, so `scene.filling.threshold` keeps its default.",
    "search_threshold": "is not needed: cells are enclosed by the vote of 26 rays (`scene.filling.votes`).",
    "search_exclude_direction": "has no counterpart: rays go to all sides, and are outvoted where a side is open.",
    "ray_cast_direction": "has no counterpart: all rays count crossings, not one.",
    "max_particles_num": "has no counterpart: the number of points follows from the volume.",
    "boundary": "has no counterpart: all that is enclosed is filled; `scene.region` bounds it.",
    "smooth": "has no counterpart: the density is blurred by half a cell.",
    "visualize": "has no counterpart: filled points are never drawn.",
}


def filling_settings(fields: Any, n_grid: int, grid_lim: float, notes: Notes) -> dict[str, Any]:
    """``scene.filling``: another method for the same purpose, on a grid of the same spacing."""
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
