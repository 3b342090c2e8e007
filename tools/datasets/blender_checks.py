"""The relations between Blender's cloth settings and SI units, measured on panels with known solutions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from blender_cloth import POISSON_RATIO, ClothMaterial, ClothRun, Grid, require_bpy, solve_cloth

SHEET = ClothMaterial(areal_density=0.3, membrane=30.0, bending=2.75e-4)
AIR_DENSITY, DRAG = 1.225, 1.28
NOTHING = np.empty(0, dtype=np.int64)


def _row(name: str, measured: float, expected: float, unit: str, means: str) -> dict[str, Any]:
    return {
        "name": name,
        "measured": measured,
        "expected": expected,
        "ratio": measured / expected,
        "unit": unit,
        "expected_from": means,
    }


def free_fall(cell: float, quality: int) -> dict[str, Any]:
    """Acceleration of a free panel."""
    grid = Grid.of_cells(20 * cell, 20 * cell, 20)
    run = ClothRun(frames=12, quality=quality)
    height = solve_cloth(grid, grid.flat(), NOTHING, SHEET, run)[..., 2].astype(np.float64).mean(1)
    measured = -np.diff(height, 2)[1:].mean() * run.fps**2
    return _row(f"gravity, free fall, {cell} m cells", float(measured), run.gravity, "m/s^2", "gravity")


def damped_fall(cell: float, quality: int, rate: float = 2.0) -> dict[str, Any]:
    """Rate at which the velocity of a falling panel decays: v(t) = g / rate (1 - exp(-rate t))."""
    grid = Grid.of_cells(20 * cell, 20 * cell, 20)
    run = ClothRun(frames=26, quality=quality)
    material = replace(SHEET, air_rate=rate)
    height = solve_cloth(grid, grid.flat(), NOTHING, material, run)[..., 2].astype(np.float64).mean(1)
    velocity = np.diff(height) * run.fps
    measured = -np.diff(np.log(-np.diff(velocity)[1:])).mean() * run.fps
    return _row(f"damping, fall, {cell} m cells", float(measured), rate, "1/s", "decay of the acceleration")


def hanging_panel(cell: float, quality: int) -> list[dict[str, Any]]:
    """Stretch of a panel that hangs by its upper edge under its own weight, and how much narrower it gets."""
    width, height, gravity = 0.4, 0.8, 2.0
    grid = Grid.of_cells(width, height, round(height / cell), "top")
    material = replace(SHEET, air_rate=20.0)
    run = ClothRun(frames=75, quality=quality, gravity=gravity)
    pins = np.flatnonzero(grid.uv()[:, 1] > 1 - 1e-9)
    shape = (grid.columns + 1, grid.rows + 1, 3)
    last = solve_cloth(grid, grid.flat(), pins, material, run)[-1].astype(np.float64).reshape(shape)
    strain = np.diff(last[:, :, 2].mean(0)) / np.diff(grid.flat().reshape(shape)[0, :, 2]) - 1
    lower = slice(2, grid.rows // 2)  # away from the held edge, which cannot get narrower
    # a row of faces carries the rows of vertices below it; summed over all, that is rho g L^2 / 2E
    carried = material.areal_density * height * gravity * np.arange(1, grid.rows + 1) / (grid.rows + 1)
    measured = carried[lower].sum() / strain[lower].sum()
    narrower = np.diff(last[[0, -1], :, 0], axis=0)[0] / width - 1
    ratio = -0.5 * (narrower[:-1] + narrower[1:])[lower].sum() / strain[lower].sum()
    kind = f"hanging panel, {cell} m cells"
    return [
        _row(f"E h, {kind}", measured, material.membrane, "N/m", "stretch under its weight"),
        _row(f"Poisson's ratio, {kind}", ratio, POISSON_RATIO, "1", "isotropic lattice"),
    ]


def sheared_panel(cell: float, quality: int) -> dict[str, Any]:
    """Sag of the free side of a tall, narrow panel held by its left side: away from its ends it is in pure shear."""
    width, height, gravity = 0.2, 1.6, 1.0
    grid = Grid.of_cells(width, height, round(height / cell), "left")
    run = ClothRun(frames=75, quality=quality, gravity=gravity)
    pins = np.flatnonzero(grid.uv()[:, 0] < 1e-9)
    last = solve_cloth(grid, grid.flat(), pins, replace(SHEET, air_rate=20.0), run)[-1].astype(np.float64)
    fallen = (grid.flat() - last)[:, 2].reshape(grid.columns + 1, grid.rows + 1)
    sag = fallen[-1, grid.rows // 4 : -(grid.rows // 4)].mean()
    # number of columns of cells beyond each face
    along = np.arange(1, grid.columns + 1)[::-1] * SHEET.areal_density * gravity * grid.cells[0]
    lengths = np.diff(grid.flat().reshape(grid.columns + 1, grid.rows + 1, 3)[:, 0, 0])
    modulus = SHEET.membrane / (2 * (1 + POISSON_RATIO))
    return _row(f"G h, sheared panel, {cell} m cells", float((along * lengths).sum() / sag), modulus, "N/m", "its sag")


def apart_panel(cell: float, quality: int) -> dict[str, Any]:
    """Width of a hanging panel with self-contact: it must not push itself apart in its own plane."""
    grid = Grid.of_cells(0.4, 0.4, round(0.4 / cell), "top")
    pins = np.flatnonzero(grid.uv()[:, 1] > 1 - 1e-9)
    run = ClothRun(frames=25, quality=quality, gravity=2.0)
    last = [
        solve_cloth(grid, grid.flat(), pins, replace(SHEET, air_rate=20.0), replace(run, self_collision=apart))[-1]
        for apart in (True, False)
    ]
    wide, expected = (float(np.ptp(place[:, 0])) for place in last)
    return _row(f"width with self-contact, {cell} m cells", wide, expected, "m", "the same panel without")


def wind(cell: float, quality: int, speed: float = 2.0, incidence: float = 90.0) -> list[dict[str, Any]]:
    """Pressure on a free panel without gravity, and the speed that it reaches (unless the panel would turn)."""
    grid = Grid.of_cells(20 * cell, 20 * cell, 20)
    angle = math.radians(incidence)
    flow = (speed * math.cos(angle), speed * math.sin(angle), 0.0)
    pressure = 0.5 * AIR_DENSITY * DRAG * speed**2
    turns = incidence != 90.0
    run = ClothRun(frames=5 if turns else 40, quality=quality, gravity=0.0, flow=flow, pressure=pressure)
    place = solve_cloth(grid, grid.flat(), NOTHING, SHEET, run).astype(np.float64).mean(1)
    velocity = np.diff(place[:, 1]) * run.fps
    # sigma dv/dt = p (sin a - v / U): v = U sin a (1 - exp(-t / tau)), tau = sigma U / p
    ends = speed * math.sin(angle)
    rate = -np.diff(np.log(1 - velocity[:4] / ends)).mean() * run.fps
    if turns:  # the rate gives the slope with v; the first frame gives the pressure at rest
        through = 1 - math.exp(-1 / (run.fps * SHEET.areal_density * speed / pressure))
        share = 1 - through * SHEET.areal_density * speed / pressure * run.fps
        rate = velocity[0] / (ends * share) * pressure / (SHEET.areal_density * speed)
    measured = float(rate * SHEET.areal_density * ends)
    kind = f"{cell} m cells, {incidence:g} degrees"
    expected = pressure * math.sin(angle)
    rows = [_row(f"pressure, {kind}", measured, expected, "Pa", "1/2 rho C U^2 sin(incidence)")]
    if not turns:
        rows.append(_row(f"speed reached, {kind}", float(velocity[-1]), ends, "m/s", "flow"))
    return rows


def cantilever(cell: float, quality: int) -> dict[str, Any]:
    """Sag of a level strip that is clamped at one end."""
    length, gravity = 0.16, 0.2
    grid = Grid.of_cells(length, 0.08, round(length / cell))
    flat = grid.flat()[:, [0, 2, 1]]  # in the x-y plane
    material = replace(SHEET, air_rate=4.0)
    run = ClothRun(frames=125, quality=quality, gravity=gravity)
    pins = np.flatnonzero(flat[:, 0] < 3 * cell)  # three rows, so that the first face that turns is one cell wide
    shape = (grid.columns + 1, grid.rows + 1, 3)
    last = solve_cloth(grid, flat, pins, material, run)[-1].astype(np.float64).reshape(shape)
    sag = -last[-1, :, 2].mean()
    # faces on hinges: each turns by its moment over D / cell, and lowers the end by that angle times its distance
    along = flat.reshape(shape)[:, 0, 0]
    weight = material.areal_density * length / (grid.columns + 1) * gravity  # of a row of vertices, per length across
    hinges = along[2:-1]
    moment = weight * np.maximum(along - hinges[:, None], 0).sum(1)
    measured = (moment * (length - hinges)).sum() * cell / sag
    return _row(f"D, cantilever, {cell} m cells", float(measured), material.bending, "N m", "sag of a chain of hinges")


def check_relations(
    coarse: tuple[float, int] = (0.02, 16), fine: tuple[float, int] | None = (0.01, 64)
) -> dict[str, Any]:
    """Measure all relations.

    Args:
        coarse: Cell size [m] and steps per frame.
        fine: The same for a second mesh, or None.

    Returns:
        ``blender`` (its version) and ``checks``, a list with ``name``, ``measured``, ``expected``, ``ratio``, ``unit``
        and ``expected_from``.
    """
    rows: list[dict[str, Any]] = []
    for cell, quality in filter(None, (coarse, fine)):
        rows += [free_fall(cell, quality), damped_fall(cell, quality)]
        rows += hanging_panel(cell, quality)
        rows += [sheared_panel(cell, quality), apart_panel(cell, quality)]
        rows += wind(cell, quality)
        rows.append(cantilever(cell, quality))
    rows += wind(coarse[0], 4 * coarse[1], incidence=35.0)  # read from the first frame: it needs short steps
    return {"blender": require_bpy().app.version_string, "checks": rows}
