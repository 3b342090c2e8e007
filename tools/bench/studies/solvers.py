"""Two cloths that left Blender's, by a third solver as well: who is right?

``pole``: a flag held at its left edge falls under gravity alone. ``rest``: it
comes to rest, also as the least energy of a mesh. ``sail``: one held at three corners, in a wind. Needs
``bpy``; ``newton`` runs need ``newton`` and ``warp-lang``. Motions by Blender are kept in ``outputs/solvers``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch

from bench.runner import ROOT, Row, study
from gaussian_swaying import AeroForce, Box, Material, MPMSolver, PinnedRegion, Scene, Simulation
from gaussian_swaying.mpm.laws.elastic import SpringNetwork
from gaussian_swaying.scenes import GivenScene

sys.path.append(str(ROOT / "tools" / "datasets"))
from flag_motion import read_cloth, solve_pattern
from flag_reference import PATTERNS, FlagPattern, least_quality
from make_hand_films import cloth_cloud, lattice

MOTIONS = ROOT / "outputs" / "solvers"
CLOTHS = {
    "pole": replace(PATTERNS[1], frames=51),
    "rest": replace(PATTERNS[1], frames=126, damping=8.0),
    "sail": replace(PATTERNS[2], frames=11),
}
FINEST = {"pole": 96, "rest": 96, "sail": 192}
"""Cells of Blender's mesh that the others are compared with."""
SHOWN = {"pole": (5, 10, 15, 20, 25, 30, 40, 50), "rest": (125,), "sail": (2, 3, 5, 7, 10)}
U, V = np.meshgrid(np.linspace(0, 1, 25), np.linspace(0, 1, 17), indexing="ij")
"""Where the cloths are compared."""
RUNS: list[Row] = [
    *({"cloth": "pole", "solver": "blender", "cells": cells} for cells in (24, 48)),
    {"cloth": "pole", "solver": "newton", "cells": 24},
    *({"cloth": "pole", "solver": "ours", "cells": cells} for cells in (24, 36, 48, 60)),
    *({"cloth": "rest", "solver": solver, "cells": 48} for solver in ("blender", "ours", "minimum")),
    *({"cloth": "sail", "solver": "blender", "cells": cells} for cells in (24, 48, 120)),
    {"cloth": "sail", "solver": "blender", "cells": 120, "corner": 0.05},
    *({"cloth": "sail", "solver": "ours", "cells": cells} for cells in (24, 36, 48, 60)),
    *({"cloth": "sail", "solver": "ours", "cells": 60, "corner": corner} for corner in (0.025, 0.03, 0.035, 0.045)),
    {"cloth": "sail", "solver": "ours", "cells": 60, "bending": None},
]


def at_lattice(u: np.ndarray, v: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Places (frames, columns, rows, 3) at ``u`` and ``v``, at :data:`U` and :data:`V`: (frames, L, 3)."""

    def share(lines: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        below = np.clip(np.searchsorted(lines, at, side="right") - 1, 0, len(lines) - 2)
        return below, ((at - lines[below]) / (lines[below + 1] - lines[below]))[:, None]

    (i, a), (j, b) = share(u, U.ravel()), share(v, V.ravel())
    lower, upper = ((1 - b) * places[:, k, j] + b * places[:, k, j + 1] for k in (i, i + 1))
    return (1 - a) * lower + a * upper


def blender(cloth: FlagPattern, cells: int) -> np.ndarray:
    """The motion by Blender's springs."""
    cloth = replace(cloth, cells=cells)
    cloth = replace(cloth, quality=least_quality(cloth, 64))
    path = MOTIONS / f"{cloth.pinned}_{cells}_{cloth.corner:g}_{cloth.damping:g}.npz"
    solve_pattern(cloth, path)
    found = read_cloth(path)
    uv = found.uv.reshape(found.columns + 1, found.rows + 1, 2)
    return at_lattice(uv[:, 0, 0], uv[0, :, 1], found.positions.reshape(-1, *uv.shape[:2], 3).astype(float))


def newton(cloth: FlagPattern, cells: int, iterations: int = 10, substeps: int = 80) -> np.ndarray:
    """The motion of a flag on a pole by Newton's vertex block descent, with the bending of a plate across the cells."""
    import newton
    import warp

    rows, cell, E, nu = (
        round(cells * cloth.height / cloth.width),
        cloth.width / cells,
        cloth.youngs_modulus,
        cloth.poisson_ratio,
    )
    builder, stiff = newton.ModelBuilder(gravity=(0, 0, -cloth.gravity)), E * cloth.thickness
    turn = warp.quat_from_axis_angle(warp.vec3(1, 0, 0), warp.pi / 2)
    builder.add_cloth_grid(
        pos=warp.vec3(0), rot=turn, vel=warp.vec3(0), dim_x=cells, dim_y=rows, cell_x=cell, cell_y=cell, fix_left=True,
        mass=cloth.density * cloth.thickness * cell**2, tri_ke=stiff / (2 + 2 * nu), tri_ka=stiff * nu / (1 - nu**2),
        tri_kd=0.0, edge_ke=stiff * cloth.thickness**2 / (12 * (1 - nu**2)) / cell, edge_kd=0.0,
    )  # fmt: skip
    place = np.array([list(q) for q in builder.particle_q])
    rim = [
        (np.abs(place[:, axis] - 0.5 * size) > 0.5 * size - 1e-6)
        for axis, size in ((0, cloth.width), (2, cloth.height))
    ]
    mass = np.array(builder.particle_mass) * 0.5 ** np.sum(rim, 0)  # a share of the cloth for each vertex
    builder.particle_mass = mass.tolist()
    builder.color()
    model = builder.finalize(device="cpu")
    order = np.lexsort((place[:, 2].round(6), place[:, 0].round(6)))
    place[:, 1] = cloth.rest(place[:, [0, 2]] / [cloth.width, cloth.height])[0][:, 1]
    solver, now, after = newton.solvers.SolverVBD(model, iterations=iterations), model.state(), model.state()
    warp.to_torch(now.particle_q).copy_(torch.from_numpy(place))
    slowed, motion = torch.from_numpy(-cloth.damping * mass)[:, None].float(), [place]
    for _ in range(cloth.frames - 1):
        for _ in range(substeps):
            warp.to_torch(now.particle_f).copy_(slowed * warp.to_torch(now.particle_qd))
            solver.step(now, after, model.control(), None, 1 / cloth.fps / substeps)
            now, after = after, now
        motion.append(warp.to_torch(now.particle_q).numpy().astype(float))
    places = np.stack(motion)[:, order].reshape(-1, cells + 1, rows + 1, 3)
    return at_lattice(np.linspace(0, 1, cells + 1), np.linspace(0, 1, rows + 1), places)


def ours(cloth: FlagPattern, cells: int, bending: Literal["plate"] | None = "plate") -> np.ndarray:
    """The motion by this package: a layer of points, four by four to a cell."""
    dx = cloth.width / cells
    spacing, size = 0.25 * dx, np.array([cloth.width, cloth.height])
    held = []
    for left, right, low, high in cloth.pin_uv():
        begin, end = size * [left, low], size * [right, high]
        (x, z), (to_x, to_z) = begin - 0.3 * spacing, end + 0.3 * spacing
        held.append(Box([x, None, z], [to_x, None, to_z]))
    simulation = Simulation(
        Scene(generator=GivenScene(cloth_cloud(cloth, spacing)), area="coverage", layers=1),
        Material(
            E=cloth.youngs_modulus,
            density=cloth.density,
            thickness=cloth.thickness,
            law=SpringNetwork(),
            bending=bending,
        ),
        solver=MPMSolver(dx, damping=cloth.damping, boundaries=[PinnedRegion(box) for box in held]),
        wind=cloth.flow,
        aero=AeroForce(C_D=cloth.drag if any(cloth.flow) else 0.0, C_F=0.0, C_L=0.0, law="linear"),
        frame_dt=1 / cloth.fps,
        device="cpu",
    )
    places = np.stack([frame.gaussians.means.double().numpy() for frame in simulation.frames(cloth.frames)])
    order = np.lexsort((places[0, :, 2].round(5), places[0, :, 0].round(5)))
    columns, rows = (len(lines) - 1 for lines in lattice(cloth, spacing))
    places = places[:, order].reshape(cloth.frames, columns, rows, 3)
    return at_lattice(places[0, :, 0, 0] / cloth.width, places[0, 0, :, 2] / cloth.height, places)


def minimum(cloth: FlagPattern, cells: int) -> np.ndarray:
    """A flag on a pole at rest: the least energy of triangles in plane stress (St. Venant and Kirchhoff)."""
    rows, nu = round(cells * cloth.height / cloth.width), cloth.poisson_ratio
    v, u = torch.meshgrid(torch.linspace(0, 1, rows + 1), torch.linspace(0, 1, cells + 1), indexing="ij")
    flat = torch.stack([u, v], -1).reshape(-1, 2).double()
    rest = torch.from_numpy(cloth.rest(flat.numpy())[0])
    number = torch.arange(len(flat)).reshape(rows + 1, cells + 1)
    a, b, c, d = (part.reshape(-1) for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)])
    sides = flat[faces] * torch.tensor([cloth.width, cloth.height], dtype=torch.float64)
    inverse = torch.linalg.inv((sides[:, 1:] - sides[:, :1]).mT)
    area, free = cloth.width * cloth.height / len(faces), (flat[:, 0] > 0)[:, None]
    stiff = cloth.youngs_modulus * cloth.thickness / (1 - nu**2)
    weight = cloth.density * cloth.thickness * cloth.gravity * area / 3
    moved = torch.zeros_like(rest, requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [moved], max_iter=3000, history_size=50, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def energy() -> torch.Tensor:
        corners = (rest + moved * free)[faces]
        stretch = (corners[:, 1:] - corners[:, :1]).mT @ inverse
        strain = 0.5 * (stretch.mT @ stretch - torch.eye(2, dtype=torch.float64))
        trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
        dense = 0.5 * stiff * ((1 - nu) * strain.square().sum((-2, -1)) + nu * trace.square())
        return (area * dense).sum() + weight * corners[..., 2].sum()

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = energy()
        value.backward()
        return value

    optimizer.step(closure)
    both = (
        torch.stack([rest, rest + (moved * free).detach()]).reshape(2, rows + 1, cells + 1, 3).transpose(1, 2).numpy()
    )
    places = at_lattice(np.linspace(0, 1, cells + 1), np.linspace(0, 1, rows + 1), both)
    return np.concatenate([places[:1], np.repeat(places[1:], cloth.frames - 1, 0)])


SOLVERS: dict[str, Callable[..., np.ndarray]] = {"blender": blender, "newton": newton, "ours": ours, "minimum": minimum}


@study("solvers", RUNS)
def solvers(cloth: str, solver: str, cells: int, corner: float = 0.04, **more: Any) -> Row:
    """The distance to Blender's finest mesh as a share of the motion (root mean squares), and the cloth's middle."""
    pattern = CLOTHS[cloth]
    true = blender(pattern, FINEST[cloth])
    found = SOLVERS[solver](replace(pattern, corner=corner), cells, **more)
    own, true = found - found[0], true - true[0]
    apart, motion = (np.sqrt((part**2).sum(-1).mean(-1)) for part in (own - true, true))
    shown = list(SHOWN[cloth])
    middle = found.mean(1)[shown] - found[0].mean(0)
    numbers = {"frames": shown, "apart_share": (apart / np.maximum(motion, 1e-12))[shown].round(4).tolist()}
    numbers |= {"motion_mm": (1e3 * motion[shown]).round(2).tolist()}
    return numbers | {
        "middle_mm": (1e3 * middle).round(2).tolist(),
        "across_mm": (1e3 * found[shown, :, 1].std(-1)).round(2).tolist(),
    }
