"""One .html file in which a visitor turns the wind: Gaussians, solver and page, all inside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying._files import check_page, write_text
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import PAGE as FILM_PAGE
from gaussian_swaying.viewer.film.page import filled, pack_head, pack_splats, parts_of
from gaussian_swaying.viewer.film.recorded import Film, film_of
from gaussian_swaying.viewer.live_web.block import check, pack_solver

PAGE = Path(__file__).parent / "page"

ELEMENT = "gaussian-swaying.js"
"""The script with which another page shows this one in a ``<gaussian-swaying>``."""


@dataclass(frozen=True)
class Written:
    """The contents of a page.

    Attributes:
        gaussians: Number of Gaussians.
        points: Number of material points.
        notes: Sentences on what the page does not show as a run does.
    """

    gaussians: int
    points: int
    notes: tuple[str, ...]


def write_live_web(simulation: Simulation, name: str, target: Path) -> Written:
    """Write a simulation as one .html file that runs in a browser.

    Args:
        simulation: The simulation; it is started.
        name: What it shows.
        target: The file; its name ends in .html.
    """
    check_page(target, "page")
    text, film = page(simulation, name)
    write_text(target, text)
    return Written(film.head["count"], simulation.setup.points.count, film.notes)


def write_element(folder: Path) -> None:
    """Write :data:`ELEMENT` to a folder."""
    write_text(folder / ELEMENT, (PAGE / ELEMENT).read_text(encoding="utf-8"))


def page(simulation: Simulation, name: str) -> tuple[str, Film]:
    """The whole page of a simulation, and the Gaussians that it shows."""
    check(simulation)
    state: Any = simulation.start()
    nodes = simulation.scene.follow.nodes(state)
    assert nodes is not None  # it is `total`
    with torch.inference_mode():
        film = film_of(simulation, state.grid, nodes, torch.zeros(0, len(nodes), 3), name)
        solver = pack_solver(simulation, nodes)
    wind = simulation.wind
    assert isinstance(wind, WindField)
    film.head["wind"] = wind.mean_flow(torch.zeros((), dtype=torch.float64)).tolist()
    return filled(PAGE / "live_web.html", film.head, blocks_of(film, solver)), film


def blocks_of(film: Film, solver: bytes) -> dict[str, bytes]:
    """The blocks that the page unpacks, in the order in which it needs them.

    Args:
        film: The Gaussians, in a film without frames.
        solver: See :func:`~gaussian_swaying.viewer.live_web.block.pack_solver`.
    """
    parts = parts_of(film.head)
    blocks = {"code": (FILM_PAGE / "film.min.js").read_bytes(), **pack_head(film, parts)}
    blocks |= {"worker": (PAGE / "worker.min.js").read_bytes(), "solver": solver}
    for index, (kind, first, last) in enumerate(parts):
        blocks[f"part-{index}"] = pack_splats(film, kind == "moving", first, last)
    return blocks
