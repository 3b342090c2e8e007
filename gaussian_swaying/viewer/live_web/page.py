"""One .html file in which a visitor turns the wind: Gaussians, solver and page, all inside it."""

from __future__ import annotations

from pathlib import Path

import torch

from gaussian_swaying._files import check_page, write_text
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import PAGE as FILM_PAGE
from gaussian_swaying.viewer.film.page import filled, pack_head, pack_splats, parts_of
from gaussian_swaying.viewer.film.recorded import Film, film_without_frames
from gaussian_swaying.viewer.live_web.block import check, pack_solver
from gaussian_swaying.wind.field import WindField

PAGE = Path(__file__).parent / "page"

ELEMENT = "gaussian-swaying.js"
"""The script with which another page shows this one in a ``<gaussian-swaying>``."""


def write_live_web(simulation: Simulation, name: str, target: Path) -> Film:
    """Write a simulation as one .html file that runs in a browser.

    Args:
        simulation: The simulation; it is started.
        name: What it shows.
        target: The file; its name ends in .html.

    Returns:
        The Gaussians, in a film without frames.
    """
    check_page(target, "page")
    check(simulation)
    state, wind = simulation.start(), simulation.wind
    nodes = simulation.scene.follow.nodes(state)
    assert nodes is not None  # it is `total` or `modes`
    assert isinstance(wind, WindField)
    with torch.inference_mode():
        film = film_without_frames(simulation, state, name)
        solver = pack_solver(simulation, nodes)
    film.head["wind"] = wind.mean_flow(torch.zeros((), dtype=torch.float64)).tolist()
    parts = parts_of(film.head)
    blocks = {"code": (FILM_PAGE / "film.min.js").read_bytes(), **pack_head(film, parts)}
    blocks |= {"worker": (PAGE / "worker.min.js").read_bytes(), "solver": solver}
    for index, (kind, first, last) in enumerate(parts):
        blocks[f"part-{index}"] = pack_splats(film, kind == "moving", first, last)
    write_text(target, filled(PAGE / "live_web.html", film.head, blocks))
    return film


def write_element(folder: Path) -> None:
    """Write :data:`ELEMENT` to a folder."""
    write_text(folder / ELEMENT, (PAGE / ELEMENT).read_text(encoding="utf-8"))
