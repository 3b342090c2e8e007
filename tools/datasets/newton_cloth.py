"""A second cloth solver: vertex block descent (Chen et al. 2024) of Newton, on the meshes of Blender's cloth.

This is the only file that runs it. ``newton`` and ``warp-lang`` (the extra ``peers``) are imported when a cloth is
solved, and run on a CPU. Masses, springs and pins are those that Blender gets, so the membrane is the same lattice;
bending is that of hinges between triangles; contact of the cloth with itself is Newton's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from blender_cloth import LATTICE, ClothMaterial, ClothRun, Grid, edges

CONTACT_STIFFNESS = 50.0
"""Stiffness of a contact between a vertex and a triangle, or two edges, once they are closer than the distance that the
cloth keeps [N/m]. Below half of that distance a barrier takes over. Chosen here: a cell of 0.5 kg/m² and 1 cm² sinks in
by its weight by 0.01 mm, and by 2 mm from 2 m/s."""

ITERATIONS = 10
"""Sweeps over all vertices in a step."""

SLACK = 0.5
"""How much farther than the distance Newton looks for contact, as a share of it."""


def require_newton() -> tuple[Any, Any]:
    """Import ``newton`` and ``warp``.

    Raises:
        ImportError: If they are not installed; the message names the extra.
    """
    try:
        import newton
        import warp
    except ImportError as error:
        raise ImportError(
            "Newton's cloth needs newton and warp-lang: install them with `pip install 'gaussian-swaying[peers]'`."
        ) from error
    warp.config.quiet = True
    return newton, warp


def settings() -> dict[str, Any]:
    """What a motion depends on besides the flag."""
    return {"solver": "newton", "newton.iterations": ITERATIONS, "newton.contact_stiffness": CONTACT_STIFFNESS}


def solve_cloth(
    grid: Grid,
    vertices: np.ndarray,
    pins: Sequence[int] | np.ndarray,
    material: ClothMaterial,
    run: ClothRun,
    report: Any = None,
) -> np.ndarray:
    """Simulate a sheet with Newton; arguments and result are those of :func:`blender_cloth.solve_cloth`.

    Raises:
        ImportError: If Newton is not installed.
        ValueError: If there is wind: Newton's force of the air is another one.
        ArithmeticError: If the solver blew up.
    """
    if run.pressure and any(run.flow):
        raise ValueError("Newton's cloth has no wind that could be matched: expected `flow` to be zero.")
    newton, warp = require_newton()
    distance = (0.5 * grid.cell if run.self_distance is None else run.self_distance) if run.self_collision else 0.0
    with warp.ScopedDevice("cpu"):
        model = _model(newton, warp, grid, np.asarray(vertices), np.asarray(pins, dtype=np.int64), material, run)
        contact = (
            {
                "particle_enable_self_contact": True,
                "particle_self_contact_margin": distance,
                "particle_self_contact_gap": SLACK * distance,
                "particle_rest_shape_contact_exclusion_radius": 2 * distance,
                "particle_vertex_contact_buffer_size": 64,
                "particle_edge_contact_buffer_size": 128,
            }
            if run.self_collision
            else {}
        )
        solver = newton.solvers.SolverVBD(model, iterations=ITERATIONS, **contact)
        now, after, control = model.state(), model.state(), model.control()
        step = 1 / (run.fps * run.quality)
        slower = math.exp(-material.air_rate * step)
        positions = np.empty((run.frames, len(vertices), 3), dtype=np.float32)
        positions[0] = vertices
        for frame in range(1, run.frames):
            if run.self_collision:
                solver.rebuild_bvh(now)
            for _ in range(run.quality):
                now.clear_forces()
                solver.step(now, after, control, None, step)
                now, after = after, now
                now.particle_qd.numpy()[:] *= slower  # memory of the host: not a copy
            positions[frame] = now.particle_q.numpy()
            if not np.isfinite(positions[frame]).all():
                raise ArithmeticError(f"Newton's cloth blew up in frame {frame + 1}: raise `quality`.")
            if report:
                report(frame + 1)
    return positions


def _model(
    newton: Any, warp: Any, grid: Grid, vertices: np.ndarray, pins: np.ndarray, material: ClothMaterial, run: ClothRun
) -> Any:
    triangles = grid.triangles()
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -run.gravity))
    builder.add_cloth_mesh(
        pos=warp.vec3(0.0, 0.0, 0.0),
        rot=warp.quat_identity(),
        scale=1.0,
        vel=warp.vec3(0.0, 0.0, 0.0),
        vertices=[warp.vec3(*map(float, v)) for v in vertices],
        indices=triangles.reshape(-1).tolist(),
        density=0.0,
        tri_ke=0.0,  # the springs below are the membrane
        tri_ka=0.0,
        tri_kd=0.0,
        edge_ke=material.bending / grid.cell,  # a sheet bent across its rows: one hinge for each cell
        edge_kd=0.0,
        particle_radius=0.0,
    )
    spring = material.membrane / LATTICE
    for first, second in edges(triangles):
        builder.add_spring(int(first), int(second), spring, material.spring_time * spring, control=0.0)
    mass = np.full(len(vertices), material.areal_density * grid.cell**2)  # every vertex the same, as in Blender
    mass[pins] = 0.0
    builder.particle_mass = mass.tolist()
    builder.color()
    model = builder.finalize(device="cpu")
    flags = model.particle_flags.numpy()
    flags[pins] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags = warp.array(flags, dtype=model.particle_flags.dtype, device="cpu")
    model.edge_rest_angle.zero_()  # flat, as the plate is
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = CONTACT_STIFFNESS, 0.0, 0.0
    return model
