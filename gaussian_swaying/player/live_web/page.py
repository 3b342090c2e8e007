"""One .html file in which a visitor turns the wind: Gaussians, solver and page, all inside it."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from gaussian_swaying._files import check_page, write_text
from gaussian_swaying.player.film.page import PAGE as FILM_PAGE
from gaussian_swaying.player.film.page import filled, pack
from gaussian_swaying.player.film.recorded import Film, film_without_frames
from gaussian_swaying.player.live_web.block import check, pack_solver
from gaussian_swaying.player.panel import group
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import WindField

PAGE = Path(__file__).parent / "page"


def write_live_web(simulation: Simulation, name: str, target: Path) -> Film:
    """Write a simulation as one .html file that runs in a browser."""
    check_page(target, "page")
    check(simulation)
    state, wind = simulation.start(), simulation.wind
    nodes = simulation.scene.follow.nodes(state)
    assert nodes is not None  # it is `total` or `modes`
    assert isinstance(wind, WindField)
    with torch.inference_mode():
        film = film_without_frames(simulation, state, name)
        solver = pack_solver(simulation, nodes)
    flow = wind.mean_flow(torch.zeros((), dtype=torch.float64)).tolist()
    rim = max(10.0, 2 * math.hypot(flow[0], flow[1]))
    factor = {"kind": "range", "unit": "×"}
    film.head["panel"] = [
        group("Wind", [
            {"kind": "dial", "name": "wind", "label": "Wind", "value": flow, "high": rim},
            factor | {"name": "gusts", "label": "gusts", "low": 0.0, "high": 3.0, "log": False, "value": 1.0},
        ]),
        group("Material", [
            factor | {"name": "stiffness", "label": "stiffness", "low": 0.125, "high": 4.0, "log": True, "value": 1.0}
        ]),
    ]  # fmt: skip
    code = {name: (folder / f"{name}.min.js").read_bytes() for name, folder in (("film", FILM_PAGE), ("worker", PAGE))}
    packed = pack(film)
    blocks = {"code": code["film"]} | {name: packed.pop(name) for name in ("head", "stencils", "part-0")}
    write_text(target, filled("page", film.head, blocks | {"worker": code["worker"], "solver": solver} | packed))
    return film
