"""What ``bench.py accuracy`` measures: errors against exact solutions and experiments."""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import torch

from bench.case import Case, Measurement, option
from bench.clock import guarded
from bench.problems import (
    apart,
    bars,
    beams,
    divergence,
    fabrics,
    flags,
    joints,
    plates,
    reconfiguration,
    rods,
    strips,
    surfaces,
    vortex,
)
from bench.problems.granular.angles import plane_strain_angle, shear_angle, triaxial_angle
from bench.problems.granular.columns import column_collapse
from bench.problems.granular.layers import angle_of_repose
from bench.problems.settings import Settings
from bench.record import Row
from gaussian_swaying.mpm.laws.sand import Sand

VARIANTS = {
    "total": Settings(),
    "updated": Settings(formulation="updated"),
    "MLS": Settings(formulation="updated", mls=True),
}
SINGLE = {"total, float32": Settings(dtype=torch.float32)}
BAR_AT_POINTS = partial(bars.vibrating_bar, ends="fixed-free", hold="points")
HANGING_AT_POINTS = partial(bars.hanging_bar, clamp="points")


def _surface(settings: Settings, **options: Any) -> dict[str, float]:
    del settings  # there is no solver in it
    return surfaces.surface_drag(**options)


def _held(case: tuple[float, float, tuple[float, float], float, Settings]) -> dict[str, float]:
    thickness, depth, place, angle, settings = case
    # a beam in plane strain that is more than 2.5 cells high and one cell wide is a sheet to the default
    kind = "clamp" if thickness > 2 else None
    points = 4 if thickness < 2 else 3 if thickness < 8 else 2  # per cell; a thick beam has enough of them across
    return beams.held_cantilever(settings, thickness, depth, place, angle, kind=kind, per_cell=points)


def _held_anyhow(thickness: float, depth: float, settings: Settings) -> dict[str, float]:
    """The worst of eight cantilevers: at four places on the grid and two angles to it, in processes of their own."""
    places = ((0.0, 0.0), (0.25, 0.13), (0.5, 0.37), (0.81, 0.71))
    each = [(thickness, depth, place, angle, settings) for place in places for angle in (0.0, 0.5)]
    with ProcessPoolExecutor(min(8, os.cpu_count() or 1), mp_context=multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(_held, each))
    ratios = [result["ratio"] for result in found]
    worst = max(found, key=lambda result: result["error"])
    return worst | {"lowest": min(ratios), "highest": max(ratios)}


def _clamped_end(cells: int, settings: Settings) -> dict[str, float]:
    """A beam of one shape on finer and finer grids, 1.3 cells from its end held, off the planes of the nodes."""
    place, length = (0.25, 0.13), 8.0 * cells
    return beams.held_cantilever(settings, float(cells), 1.3, place, length=length, kind="clamp", per_cell=4)


def _comb(thickness: float, gap: float, how: str, settings: Settings) -> dict[str, float]:
    return apart.comb(settings, thickness, gap, base=how == "base", shared=how == "shared")


def _rod_anyhow(diameter: float, around: int, settings: Settings) -> dict[str, float]:
    """The worst of nine rods: at three places on the grid and in three directions."""
    places = ((0.0, 0.0, 0.0), (0.25, 0.13, 0.4), (0.5, 0.37, 0.5))
    axes = ((1.0, 0.0, 0.0), (1.0, 0.5, 0.3), (1.0, 0.9, 0.1))
    found = [rods.rod(settings, diameter, place, axis, around=around) for place in places for axis in axes]
    ends = {"lowest": min(one["lowest"] for one in found), "highest": max(one["highest"] for one in found)}
    return max(found, key=lambda one: one["error"]) | ends


def _elements(settings: Settings) -> dict[str, float]:
    del settings  # element tests need no solver
    law = Sand(friction_angle=30.0)
    return {
        "shear_deg": shear_angle(law),
        "triaxial_deg": triaxial_angle(law),
        "plane_strain_deg": plane_strain_angle(law),
    }


def cases(device: str, thorough: bool) -> Iterable[tuple[str, Row, Callable[[], dict[str, float]]]]:
    """The name, the parameters and the function of each measurement."""
    everyone = {**VARIANTS, **SINGLE}

    def case(name: str, function: Callable[..., Any], variant: str, **parameters: Any) -> Any:
        settings = replace(everyone[variant], device=device)
        return name, {"variant": variant, **parameters}, lambda: function(settings=settings, **parameters)

    for variant in everyone:
        for cells in (8, 16, 32, 64):
            for ends in ("free", "fixed-free"):
                yield case("vibrating bar", bars.vibrating_bar, variant, cells=cells, ends=ends)
    for cells in (8, 16, 32):
        options = {"ends": "fixed-free", "confined": False, "poisson_ratio": 0.0}
        yield case("unconfined bar", bars.vibrating_bar, "total", cells=cells, **options)
    for variant in everyone:
        for clamp in ("mirror", "pin"):
            for cells in (8, 16, 32):
                yield case("hanging bar", bars.hanging_bar, variant, cells=cells, clamp=clamp)
    for variant in ("total", "total, float32"):
        for cells in (8, 16, 32, 64):
            yield case("bar held at points", BAR_AT_POINTS, variant, cells=cells)
        for cells in (8, 16, 32):
            yield case("hanging bar held at points", HANGING_AT_POINTS, variant, cells=cells)
    for hold in ("hinge", "clamp", "nodes"):
        for cells in (8, 16, 32):
            for layers in (3, 1):
                yield case("hinged strip", strips.hinged_strip, "total", cells=cells, hold=hold, layers=layers)
    for variant in VARIANTS:
        for cells in (1, 2, 3, 4) if thorough else (1, 2):
            yield case("cantilever", beams.cantilever, variant, cells=cells, b=1.0)
    for b in (0.5, 2.0, 4.0, 8.0):
        yield case("cantilever", beams.cantilever, "total", cells=2, b=b)
    for thickness in (0.3, 1.0, 2.0, 4.0, 8.0) if thorough else (0.3, 2.0):
        for depth in (0.34, 0.51, 1.01, 2.01) if thickness < 8 else (1.01,):
            yield case("held cantilever", _held_anyhow, "total", thickness=thickness, depth=depth)
    for cells in (2, 3, 4, 6, 8):
        yield case("clamped end", _clamped_end, "total", cells=cells)
    for thickness in (0.3, 1.0):
        for how in ("apart", "base", "shared"):
            yield case("comb", _comb, "total", thickness=thickness, gap=0.3, how=how)
    for layers in (1, 3):
        yield case("close sheets", apart.sheets, "total, float32", gap=0.2, layers=layers)
    yield case("pendulum on a hinge", joints.pendulum, "total")
    for turning in (0.1, 1.0, 10.0, 1000.0):
        yield case("joined beams", joints.joined_beams, "total", turning=turning)
    for around in (4, 8):
        for diameter in (0.05, 0.1, 0.3, 1.0):
            yield case("thin rod", _rod_anyhow, "total", diameter=diameter, around=around)
    for variant in everyone:
        for cells in (16, 24, 32, 48) if thorough and variant == "total" else (16, 24, 32):
            yield case("vortex", vortex.vortex, variant, cells=cells)
    for variant in VARIANTS:
        yield case("free block", bars.free_block, variant, periods=100 if variant == "total" else 20)
    for variant in ("total", "updated"):
        for law, ks in (("paper", (0.25, 0.5, 0.75)), ("projected", (0.25, 0.5, 1.0, 2.0))):
            for k in ks:
                yield case("hinged plate", plates.hinged_plate, variant, k=k, law=law)
    for fabric, stretch, cells in [
        *product(fabrics.FABRICS, (1000.0,), (16,)),
        *product(("ponte",), (300.0, 1000.0), (8, 32)),
        ("ponte", 300.0, 16),
    ]:
        for layers in (3, 1):
            options = {"fabric": fabric, "stretch": stretch, "cells": cells, "layers": layers}
            yield case("strip of a fabric that hangs", fabrics.hanging_strip, "total, float32", **options)
    finest = ((law, 1000.0, 64) for law in reconfiguration.POWERS)
    for law, cauchy, cells in [*product(reconfiguration.POWERS, (1.0, 10.0, 100.0, 1000.0), (16, 32)), *finest]:
        options = {"law": law, "cauchy": cauchy, "cells": cells} | ({"slenderness": 80.0} if cells == 64 else {})
        yield case("plate that bends in a flow", reconfiguration.reconfiguration, "total", **options)
    for cells in (8, 16, 32):
        options = {"cells": cells, "slenderness": 60.0}
        yield case("inverted flag", divergence.divergence, "total", **options)
    for shape in ("plate", "sphere"):
        for law in ("paper", "projected"):
            for count, overlap in ((500, 0.5), (2000, 0.3), (2000, 1.0), (6000, 0.5)):
                for area in ("coverage", "paper"):
                    options = {"shape": shape, "law": law, "count": count, "overlap": overlap, "area": area}
                    yield case("surface drag", _surface, "total", **options)
    yield case("sand element", _elements, "updated")
    yield case("sand slope", angle_of_repose, "updated")
    for cells in (4, 8, 16) if thorough else (4, 8):
        yield case("sand column", column_collapse, "updated", aspect=1.0, cells=cells)
    for aspect in (0.5, 2.0, 3.0):
        yield case("sand column", column_collapse, "updated", aspect=aspect, cells=16 if thorough else 8)
    for aspect in (0.5, 1.0, 2.0, 3.0):
        yield case("sand column", column_collapse, "updated", aspect=aspect, cells=8, volume_correction=False)
    if thorough:
        for aspect in (0.5, 1.0, 2.0):
            yield case("sand column", column_collapse, "updated", aspect=aspect, cells=8, planar=False)
        for dx in (0.08, 0.04, 0.02, 0.01) if device == "cuda" else ():  # tens of thousands of particles
            for density in (20.0, 50.0):
                yield case("soft flag", _soft_flag, "total, float32", dx=dx, density=density)


def _soft_flag(dx: float, density: float, settings: Settings) -> dict[str, float]:
    """Run 250 frames of the softest of the paper's flags."""
    body = {"spacing": dx / 2, "youngs_modulus": 3e3, "density": density}
    return flags.flag(dx, settings, frames=250, wind=(2.5, 0.5, 0.0), **body)[0]


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """All cases, or those whose problem has ``only`` in its name; a case that fails is recorded with its message."""
    only = options.only or ""
    result["rows"] = [row for row in result.get("rows", []) if only and only not in row["problem"]]
    for name, parameters, function in cases(options.device, options.thorough):
        if only in name:
            place = {"problem": name, "parameters": parameters}
            yield ("rows", place), lambda function=function: {"result": guarded(function)}


CASE = Case(
    "Measure errors against exact solutions and experiments.",
    rows,
    (
        option("--only", "only the problems whose name contains this"),
        option("--thorough", "finer grids and full 3D; for a GPU", action="store_true"),
    ),
    page="validation.md",
    keeps="any",
)
