"""A soft body in wind by Newton: tetrahedra of a Neo-Hookean material, and the wind as pressure on its skin.

``newton`` and ``warp-lang`` (the extra ``peers``) are imported when a body is solved, and run on a CPU. Newton computes
the elastic forces and the motion (``SolverSemiImplicit``: symplectic Euler with small steps, so there is neither an
iteration that may not have converged nor the damping of an implicit step), numpy the force of the air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


def require_newton() -> tuple[Any, Any]:
    """Import ``newton`` and ``warp``."""
    try:
        import newton
        import warp
    except ImportError as error:
        raise ImportError(
            "The soft body needs newton and warp-lang: install them with `pip install 'gaussian-swaying[peers]'`."
        ) from error
    warp.config.quiet = True
    return newton, warp


@dataclass(frozen=True)
class Air:
    """Steady wind on the skin of a body.

    Attributes:
        flow: Its velocity [m/s], (3,).
        density: Density of the air [kg/m³].
        drag: Coefficient of each side that meets or leaves the wind: a plate or a prism has two of them.
    """

    flow: tuple[float, float, float]
    density: float = 1.225
    drag: float = 1.0


def skin_forces(positions: np.ndarray, velocities: np.ndarray, triangles: np.ndarray, air: Air) -> np.ndarray:
    r"""Pressure of the wind on triangles, a third of it on each corner.

    .. math:: \\mathbf{f} = \\tfrac12 \\rho\\, C A\\, v_r\\, (\\mathbf{v}_r \\cdot \\mathbf{n})\\, \\mathbf{n}

    with the velocity of the air relative to the middle of the triangle. It does not depend on the side that a normal
    points to: the side in the wind is pushed and the one in the lee is pulled.

    Units: ``positions`` [m]; ``velocities`` [m/s].

    Returns:
        Forces on the vertices [N], float64, shape (V, 3).
    """
    a, b, c = (positions[triangles[:, k]].astype(np.float64) for k in range(3))
    double = np.cross(b - a, c - a)  # normal times twice the area
    area = np.maximum(np.linalg.norm(double, axis=1), 1e-30)
    relative = np.asarray(air.flow) - velocities[triangles].astype(np.float64).mean(1)
    along = np.einsum("tk,tk->t", relative, double) / area
    size = 0.25 * air.density * air.drag * np.linalg.norm(relative, axis=1) * along  # rho C A / 2, A = area / 2
    third = (size[:, None] * double) / 3
    corners, count = triangles.reshape(-1), len(positions)
    shared = np.repeat(third, 3, axis=0)
    return np.stack([np.bincount(corners, shared[:, k], count) for k in range(3)], axis=1)


def newton_moduli(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    r"""The numbers ``k_mu`` and ``k_lambda`` for which Newton's body has these moduli at small strain [Pa].

    The stress is :math:`\\mu_N (1 - 1 / (I_C + 1)) F + \\lambda_N (J - \\alpha)\\,\\partial J / \\partial F` (Smith, de
    Goes and Kim 2018, "Stable Neo-Hookean Flesh Simulation", section 3.4), so :math:`\\mu_N = 4/3\\,\\mu` and
    :math:`\\lambda_N = \\lambda + 5/6\\,\\mu`. Lamé's own constants would give a body that is a quarter softer.
    """
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    lam = youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
    return 4 / 3 * mu, lam + 5 / 6 * mu


@dataclass(frozen=True)
class Block:
    """An upright block of square section, its lower end held.

    Lengths are in m, ``density`` in kg/m³, the moduli those at small strain [Pa]. ``held`` is the height of what does
    not move; ``cells`` lie along a side, of five tetrahedra each.
    """

    side: float
    height: float
    held: float
    cells: int
    youngs_modulus: float
    poisson_ratio: float
    density: float

    @property
    def counts(self) -> tuple[int, int, int]:
        """Cells along x, y and z."""
        return self.cells, self.cells, round(self.height / self.cell)

    @property
    def cell(self) -> float:
        """Side of a cell [m]."""
        return self.side / self.cells

    def vertices(self) -> np.ndarray:
        """Rest positions [m], x fastest, then y; the middle of the foot is the origin; shape (V, 3)."""
        x, y, z = (np.arange(count + 1) * self.cell for count in self.counts)
        grid = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1).reshape(-1, 3)
        return grid - [0.5 * self.side, 0.5 * self.side, 0.0]


def solve_block(
    block: Block, air: Air, frames: int, fps: float, steps: int, gravity: float, damping: float
) -> np.ndarray:
    """Simulate a block with Newton, from rest.

    Units: ``fps`` [1/s]; ``gravity``, downwards [m/s²]; ``damping``, the rate at which velocities decay [1/s].

    Returns:
        Positions of :meth:`Block.vertices` at each frame [m], float32, shape (F, V, 3).
    """
    newton, warp = require_newton()
    with warp.ScopedDevice("cpu"):
        model, triangles = _model(newton, warp, block, gravity)
        solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        now, after, control = model.state(), model.state(), model.control()
        step = 1 / (fps * steps)
        slower = math.exp(-damping * step)
        positions = np.empty((frames, model.particle_count, 3), dtype=np.float32)
        positions[0] = now.particle_q.numpy()
        for frame in range(1, frames):
            for _ in range(steps):
                now.clear_forces()
                forces = skin_forces(now.particle_q.numpy(), now.particle_qd.numpy(), triangles, air)
                now.particle_f.numpy()[:] = forces  # memory of the host: not a copy
                solver.step(now, after, control, None, step)
                now, after = after, now
                now.particle_qd.numpy()[:] *= slower
            positions[frame] = now.particle_q.numpy()
            reach = np.abs(positions[frame] - positions[0]).max()
            if not reach < 2 * block.height:
                raise ArithmeticError(f"Newton's body blew up in frame {frame + 1}: raise `steps`.")
    return positions


def _model(newton: Any, warp: Any, block: Block, gravity: float) -> tuple[Any, np.ndarray]:
    mu, lam = newton_moduli(block.youngs_modulus, block.poisson_ratio)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    across, along, up = block.counts
    builder.add_soft_grid(
        pos=warp.vec3(-0.5 * block.side, -0.5 * block.side, 0.0),
        rot=warp.quat_identity(),
        vel=warp.vec3(0.0, 0.0, 0.0),
        dim_x=across,
        dim_y=along,
        dim_z=up,
        cell_x=block.cell,
        cell_y=block.cell,
        cell_z=block.cell,
        density=block.density,
        k_mu=mu,
        k_lambda=lam,
        k_damp=0.0,
        add_surface_mesh_edges=False,
        particle_radius=0.0,
    )
    vertices = block.vertices()
    tetrahedra = np.asarray(builder.tet_indices).reshape(-1, 4)
    mass = lumped_mass(vertices, tetrahedra, block.density)  # Newton gives each vertex that of a whole cell
    held = vertices[:, 2] < block.held + 1e-6
    mass[held] = 0.0
    builder.particle_mass = mass.tolist()
    triangles = np.asarray(builder.tri_indices).reshape(-1, 3)
    model = builder.finalize(device="cpu")
    flags = model.particle_flags.numpy()
    flags[held] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags = warp.array(flags, dtype=model.particle_flags.dtype, device="cpu")
    return model, triangles


def lumped_mass(vertices: np.ndarray, tetrahedra: np.ndarray, density: float) -> np.ndarray:
    """Masses of vertices (V, 3), a quarter of each of their tetrahedra (T, 4) [kg], shape (V,)."""
    a, b, c, d = (vertices[tetrahedra[:, k]] for k in range(4))
    volume = np.abs(np.einsum("tk,tk->t", np.cross(b - a, c - a), d - a)) / 6
    return np.bincount(tetrahedra.reshape(-1), np.repeat(0.25 * density * volume, 4), len(vertices))
