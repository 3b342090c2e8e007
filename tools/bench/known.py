"""Known answers: exact solutions and published numbers, in one table.

A row is a problem with the parameters of a run on a coarse grid, which the tests make, those of runs on fine grids,
which ``python tools/bench.py known`` records and the nightly tests make, and a goal: between which numbers results
lie. ``variant`` is a name in :data:`VARIANTS`. Several ``cells`` are runs on several grids: the results are those of
the last one, with the least observed ``order`` of convergence. ``worst`` has lists of other arguments: all choices
are run, and the results are those of the largest error, with the ``lowest`` and the ``highest`` ratio.
"""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise, product
from typing import Any

import torch

from bench.problems import (
    air,
    apart,
    bars,
    beams,
    crowns,
    divergence,
    drapes,
    fabrics,
    falling,
    flags,
    flutter,
    joints,
    plates,
    reconfiguration,
    rods,
    strips,
    surfaces,
    trees,
    tumbling,
    vortex,
    wrinkles,
)
from bench.problems.granular.angles import plane_strain_angle, shear_angle, triaxial_angle
from bench.problems.granular.columns import column_at_rest, column_collapse
from bench.problems.granular.deposit import lube
from bench.problems.granular.layers import angle_of_repose, inclined_layer, tossed_layer
from bench.problems.settings import Settings
from bench.runner import Row, study
from gaussian_swaying.mpm.laws.plastic import Sand

VARIANTS = {
    "total": Settings(),
    "updated": Settings(formulation="updated"),
    "total, float32": Settings(dtype=torch.float32),
}
ANY = math.inf
Bound = float | Callable[[Row], float]
Goal = dict[str, tuple[Bound, Bound]]


@dataclass(frozen=True)
class Known:
    """A problem and its answer.

    Attributes:
        name: What the pages call it.
        function: Makes the results; it may take ``settings`` and ``device``.
        goal: For each result the least and the largest number, or functions of parameters and results that make them.
        coarse: Parameters of the runs that the tests make.
        fine: Parameters of those that are recorded.
        loose: Goals of coarse runs that replace those of fine ones.
        page: The page that shows the finest run.
    """

    name: str
    function: Callable[..., Any]
    goal: Goal
    coarse: Sequence[Row] = ()
    fine: Sequence[Row] = ()
    loose: Goal = field(default_factory=dict)
    page: str = ""

    def measure(self, device: str = "cpu", **parameters: Any) -> Row:
        """The results of a run."""
        given, asked = dict(parameters), inspect.signature(self.function).parameters
        variant, choices, cells = given.pop("variant", None), given.pop("worst", None), given.get("cells")
        if variant is not None:
            given["settings"] = replace(VARIANTS[variant], device=device)
        elif "device" in asked:
            given["device"] = device
        if choices:
            every = [self.function(**given | dict(zip(choices, c, strict=True))) for c in product(*choices.values())]
            ends = [
                f([one.get(key, one.get("ratio")) for one in every]) for f, key in ((min, "lowest"), (max, "highest"))
            ]
            return max(every, key=lambda one: one["error"]) | dict(zip(("lowest", "highest"), ends, strict=True))
        if not isinstance(cells, (tuple, list)):
            found = self.function(**given)
            return {"error": found} if isinstance(found, float) else found
        found = [self.measure(device, **parameters | {"cells": n}) for n in cells]
        return found[-1] | {"order": observed_order(cells, [one["error"] for one in found])}

    def verdicts(self, results: Row, goal: Goal) -> dict[str, tuple[float, float, float]]:
        """For each result of a goal what it is, and between which numbers it has to be."""

        def number(bound: Bound) -> float:
            return bound(results) if callable(bound) else bound

        return {name: (results[name], number(low), number(high)) for name, (low, high) in goal.items()}

    def missed(self, results: Row, goal: Goal) -> list[str]:
        """Results that are not as they should be."""
        found = self.verdicts(results, goal).items()
        return [
            f"{name} is {value:.6g}, not in [{a:.6g}, {b:.6g}]" for name, (value, a, b) in found if not a <= value <= b
        ]


def observed_order(cells: Sequence[int], errors: Sequence[float]) -> float:
    """The least order of convergence in the size of a cell between two grids."""
    pairs = pairwise(zip(cells, errors, strict=True))
    return min(math.log(abs(a / b)) / math.log(m / n) for (n, a), (m, b) in pairs)


def near(value: float, off: float) -> tuple[float, float]:
    """Numbers that are at most so far from a value."""
    return value - off, value + off


def within(most: Bound) -> tuple[Bound, Bound]:
    """Numbers of at most this size."""
    return (lambda r: -most(r), most) if callable(most) else (-most, most)


def of(name: str, share: float = 1.0, more: float = 0.0) -> Callable[[Row], float]:
    """A bound that is a share of another result."""
    return lambda results: share * results[name] + more


SECOND = (1.8, ANY)
"""Quadratic splines blur a field by terms of dx²; a tenth less, for the grids are not infinitely fine."""


def _held(thickness: float, depth: float, place: Sequence[float], angle: float, settings: Settings) -> Row:
    # a beam in plane strain that is more than 2.5 cells high and one cell wide is a sheet to the default
    kind = "clamp" if thickness > 2 else None
    points = 4 if thickness < 2 else 3 if thickness < 8 else 2  # per cell; a thick beam has enough of them across
    return beams.held_cantilever(settings, thickness, depth, tuple(place), angle, kind=kind, per_cell=points)  # type: ignore[arg-type]


def _comb(thickness: float, gap: float, how: str, settings: Settings, **more: Any) -> Row:
    return apart.comb(settings, thickness, gap, base=how == "base", shared=how == "shared", **more)


def _single_layer(hold: str, settings: Settings) -> Row:
    options = {"hold": hold, "shift": 0.3, "layers": 1}
    thin = strips.hinged_strip(8, settings, **options)
    thick = strips.hinged_strip(8, settings, slenderness=6, sag=0.001, **options)
    return thin | {"thicker": thick["error"] - thin["error"]}


def _angles(friction: float, correction: bool = False) -> Row:
    law = Sand(friction, correction)
    return {
        "shear_deg": shear_angle(law),
        "triaxial_deg": triaxial_angle(law),
        "plane_strain_deg": plane_strain_angle(law),
    }


def _slopes(settings: Settings) -> Row:
    """A layer of sand on an incline of 30 and on one of 40 degrees."""
    gain, speed, _ = inclined_layer([30.0, 40.0], settings, cells=4, seconds=0.4)
    return {"gain_30": gain[0], "speed_30": speed[0], "gain_40": gain[1], "speed_40": speed[1]}


def _spread(cells: int, duration: float) -> Row:
    each = ((1.0, 30.0), (2 / 3, 30.0), (1.0, 20.0))
    tall, low, weak = (column_collapse(a, cells=cells, friction_angle=f, duration=duration) for a, f in each)
    return tall | {"lower": low["runout"] / tall["runout"], "weaker": weak["runout"] / tall["runout"]}


def _tossed(**options: Any) -> Row:
    return tossed_layer(**options) | {"gaps": tossed_layer(volume_correction=False, **options)["error"]}


def _both_ways(froude: float, **options: Any) -> Row:
    """A plate that falls tilted one way, and how far its mirror image is from it in the first 1000 steps."""
    one, other = (tumbling.falling(froude, tilt=tilt, **options) for tilt in (0.3, -0.3))
    apart = abs(one["angles"][:1000] + other["angles"][:1000]).max()
    return {name: one[name] for name in ("turns", "swing", "speed")} | {"mirrored": float(apart)}


def _falls(froude: float, **options: Any) -> Row:
    found = tumbling.falling(froude, **options)
    return {name: found[name] for name in ("turns", "swing", "speed")}


def _soft_flag(dx: float, density: float, settings: Settings) -> Row:
    body = {"spacing": dx / 2, "youngs_modulus": 3e3, "density": density}
    return flags.flag(dx, settings, frames=250, wind=(2.5, 0.5, 0.0), **body)[0]


PLACES = ((0.0, 0.0), (0.25, 0.13), (0.5, 0.37), (0.81, 0.71))
SPOTS = ((0.0, 0.0, 0.0), (0.25, 0.13, 0.4), (0.5, 0.37, 0.5))
AXES = ((1.0, 0.0, 0.0), (1.0, 0.5, 0.3), (1.0, 0.9, 0.1))
AT_POINTS = partial(bars.vibrating_bar, ends="fixed-free", hold="points")
FREE = {"variant": "total", "ends": "free"}
CLAMPED = {"variant": "total", "ends": "fixed-free"}
BLUR = 2.5
"""The variance of a quadratic spline is dx² / 4, so it blurs a wave by (k dx)² / 8: pi² / 8 over the square of the
cells of a free bar, and a quarter of that if one end is fixed; twice that."""

KNOWN = [
    Known(
        "bar with free ends, frequency", bars.vibrating_bar,
        {"error": within(lambda r: BLUR / _last(r) ** 2), "order": SECOND},
        [FREE | {"cells": (16, 32, 64), "periods": 2},
         FREE | {"variant": "updated", "cells": (16, 32), "strain": 0.001, "periods": 2}],
        [FREE | {"variant": name, "cells": (32, 64)} for name in VARIANTS],
        page="accuracy.md",
    ),
    Known(
        "slender bar with free ends", bars.vibrating_bar, {"error": within(0.005), "order": SECOND},
        fine=[FREE | {"cells": (16, 64), "periods": 2, "confined": False, "poisson_ratio": 0.0}],
    ),
    Known(
        "bar of the updated formulation at a strain of 0.1", bars.vibrating_bar, {"error": within(0.005)},
        [FREE | {"variant": "updated", "cells": 32, "periods": 2}],
    ),
    Known(
        "what a vibrating bar loses, over what transfers smooth", bars.losses,
        # the stencils of the last two cells at each end see fewer points: a quarter of the bar
        {"adaptive": within(2e-3), "fixed": within(1e-6), "ratio": near(1, 0.25)}, [{}],
    ),
    Known(
        "bar held at points of its wall, frequency", AT_POINTS,
        {"error": within(lambda r: BLUR / 4 / _last(r) ** 2), "order": SECOND, "end_shift": within(0.05),
         "loss": within(1e-4)},
        [{"variant": "total", "cells": (8, 16), "periods": 2, "shift": 0.3}],
        [{"variant": name, "cells": (32, 64)} for name in ("total", "total, float32")],
        {"error": within(0.002)},
    ),
    Known(
        "bar held at points of both walls", partial(bars.vibrating_bar, ends="fixed", hold="points"),
        {"error": within(0.01)},
        [{"variant": "total", "cells": 16, "periods": 2, "shift": 0.3}],
    ),
    Known(
        # two points to a cell couple the slopes between nodes by 3 : 10 : 3, so the slope falls by -1/3 from one to the
        # next and the displacement is that of a bar longer by a quarter of a cell
        "bar held by nodes: where its wall seems to be [cells]", bars.vibrating_bar,
        {"end_shift": (lambda r: 0.25 - 0.5 / r["cells"], lambda r: 0.25 + 0.5 / r["cells"]),
         "error": within(lambda r: 0.32 / r["cells"])},
        [CLAMPED | {"cells": n, "periods": 2} for n in (16, 32)], [CLAMPED | {"cells": 64}],
    ),
    Known(
        "bar held by nodes in `updated`", bars.vibrating_bar, {"end_shift": within(0.5)},
        [CLAMPED | {"variant": "updated", "cells": 32, "periods": 2}], [CLAMPED | {"variant": "updated", "cells": 64}],
        {"end_shift": near(-0.75, 0.05)},
    ),
    Known(
        "hanging bar held by nodes", bars.hanging_bar, {"end_shift": near(0.25, 0.005), "error": near(0.5 / 32, 0.001)},
        [{"variant": "total", "cells": 32, "clamp": "pin"}], [{"variant": "total", "cells": 32, "clamp": "pin"}],
    ),
    Known(
        "bar that hangs under its own weight, tip", bars.hanging_bar,
        {"error": within(lambda r: 0.26 / _last(r) ** 2), "order": SECOND, "profile": within(0.01),
         "residual": within(1e-4)},
        fine=[{"variant": name, "cells": (16, 32), "clamp": "mirror"} for name in ("total", "total, float32")],
    ),
    Known(
        "hanging bar in `updated`, tip", bars.hanging_bar, {"error": within(lambda r: 0.26 / r["cells"] ** 2)},
        [{"variant": "updated", "cells": 16}], [{"variant": "updated", "cells": 32, "clamp": "mirror"}],
        {"error": within(0.01)},
    ),
    Known(
        "bar that hangs from points, tip", partial(bars.hanging_bar, clamp="points"),
        {"error": within(lambda r: 0.26 / r["cells"] ** 2)},
        [{"variant": "total", "cells": 16, "shift": 0.3}], [{"variant": "total", "cells": 32}],
    ),
    Known(
        "strip on hinges under a side load, sag", strips.hinged_strip,
        {"error": within(lambda r: 1 / r["cells"] ** 2), "residual": within(1e-3), "slope": near(1, 0.01)},
        [{"variant": "total", "cells": 4, "shift": 0.3}],
        [{"variant": "total", "cells": 16, "hold": "hinge", "layers": n} for n in (3, 1)],
        {"error": within(0.15), "slope": near(1, 0.05), "moment": within(0.5)},
        page="accuracy.md",
    ),
    Known(
        "strip on clamps, whose sag is a fifth", strips.hinged_strip,
        {"error": (0.75, lambda r: 0.8 + 1 / r["cells"] ** 2), "slope": (-ANY, 0.1)},
        [{"variant": "total", "cells": 4, "hold": "clamp"}],
        [{"variant": "total", "cells": 32, "hold": "clamp", "layers": 3}],
        {"error": (0.75, ANY), "moment": (0.5, ANY)},
    ),
    Known(
        "strip of one layer on hinges", _single_layer,
        {"error": within(0.02), "residual": within(1e-3), "thicker": within(0.005)},
        [{"variant": "total", "hold": "hinge"}],
    ),
    Known(
        "strip of one layer on clamps", _single_layer,
        {"error": near(0.8, 0.02), "residual": within(1e-3), "thicker": within(0.005)},
        [{"variant": "total", "hold": "clamp"}],
    ),
    Known(
        "vortex with rotations of a radian", vortex.vortex,
        {"error": within(0.03), "order": SECOND}, [{"variant": "updated", "cells": (8, 12), "amplitude": 0.5}],
        [{"variant": name, "cells": (24, 32)} for name in VARIANTS],
        # a transfer is off by dx² / 8 of the second derivative, 64 times the turn at its crest; there are two
        {"error": within(lambda r: 2 * 64 / 8 / _last(r) ** 2)},
        page="accuracy.md",
    ),
    Known(
        "cantilever under its weight: drop that neither shear nor quadrature explains", beams.cantilever,
        {"unexplained": within(0.005), "residual": within(1e-3), "error": within(0.04)},
        [{"variant": "total", "cells": n, "slenderness": 4, "settle": 9.0} for n in (2, 3)],
        [{"variant": "total", "cells": n, "b": 1.0} for n in (2, 3, 4)]
        + [{"variant": "total", "cells": 2, "b": b} for b in (4.0, 8.0)],
        {"quadrature": (lambda r: 0.95 / (4 * r["cells"] ** 2 - 1), lambda r: 1.05 / (4 * r["cells"] ** 2 - 1)),
         "error": within(lambda r: r["shear"] + r["quadrature"] + 0.005)},
        page="accuracy.md",
    ),
    Known(
        "cantilever of one cell: two layers of points bend without strain", beams.cantilever, {"error": (1.0, ANY)},
        [{"variant": "total", "cells": 1, "slenderness": 4, "settle": 9.0}],
        [{"variant": "total", "cells": 1, "b": 1.0}],
    ),
    Known(
        "cantilever of one cell with three layers", beams.cantilever, {"unexplained": within(1.8 / 16)},
        [{"variant": "total", "cells": 1, "slenderness": 4, "settle": 9.0, "per_cell": 3}],
    ),
    Known(
        "cantilever held in a region, frequency, at four places and two angles", _held, {"error": within(0.03)},
        [{"variant": "total", "thickness": 2.0, "depth": 0.51, "place": (0.25, 0.13), "angle": 0.0}],
        [{"variant": "total", "thickness": t, "depth": d, "worst": {"place": PLACES, "angle": (0.0, 0.5)}}
         for t, d in ((0.3, 0.34), (1.0, 0.34), (2.0, 0.34), (4.0, 0.34), (8.0, 1.01))],
    ),
    Known(
        "rod of 8 points in a section, frequency, at three places and in three directions", rods.rod,
        {"error": within(0.05)},
        [{"variant": "total", "diameter": 0.3, "place": SPOTS[1], "axis": axis, "length": 8.0} for axis in AXES[:2]],
        [{"variant": "total", "diameter": d, "around": 8, "worst": {"place": SPOTS, "axis": AXES}}
         for d in (0.05, 0.1, 0.3, 1.0)],
        {"error": within(0.06), "lowest": (0.0, of("highest"))},
        page="accuracy.md",
    ),
    Known(
        "comb of beams 0.3 cells apart, each a piece, frequencies", _comb, {"error": within(0.03)},
        [{"variant": "total", "thickness": 1.0, "gap": 0.3, "how": "apart", "count": 3, "shortest": 6.0}],
        [{"variant": "total", "thickness": t, "gap": 0.3, "how": "apart"} for t in (0.3, 1.0)],
    ),
    Known(
        "comb of beams whose held ends are one piece, frequencies", _comb, {"error": within(0.03)},
        [{"variant": "total", "thickness": 1.0, "gap": 0.3, "how": "base", "count": 3, "shortest": 6.0}],
        [{"variant": "total", "thickness": t, "gap": 0.3, "how": "base"} for t in (0.3, 1.0)],
        {"error": (0.02, 0.3)},
    ),
    Known(
        "comb of beams on shared nodes, which make one plate of it", _comb, {"error": (1.0, ANY)},
        [{"variant": "total", "thickness": 1.0, "gap": 0.3, "how": "shared", "count": 3, "shortest": 6.0}],
    ),
    Known(
        "sheets 0.2 cells apart, motion beside each alone", apart.sheets,
        {"error": within(1e-3), "shared": (0.1, ANY)},
        [{"variant": "total, float32", "gap": 0.2, "layers": 1, "cells": 6, "repeats": 1}],
        [{"variant": "total, float32", "gap": 0.2, "layers": n} for n in (1, 3)],
    ),
    Known(
        "pendulum on a hinge, frequency", joints.pendulum, {"error": within(0.01)},
        [{"variant": "total", "length": 10.0}], [{"variant": "total"}], {"error": within(0.015)},
    ),
    Known(
        "two beams and a joint with stiffness, frequency", joints.joined_beams, {"error": within(0.02)},
        [{"variant": "total", "turning": k, "length": 14.0} for k in (1.0, math.inf)],
        [{"variant": "total", "turning": k} for k in (0.1, 1.0, 10.0, 1000.0)], {"error": within(0.04)},
        page="accuracy.md",
    ),
    Known(
        "free block: energy after many periods, and momenta", bars.free_block,
        {"error": within(1e-3), "growth": (-ANY, of("swing")), "linear": within(1e-12), "angular": within(1e-12)},
        [{"variant": "total", "periods": 30, "cells": 3}], [{"variant": "total", "periods": 100}],
        page="accuracy.md",
    ),
    Known(
        "free block in `updated`", bars.free_block,
        {"error": within(1e-3), "linear": within(1e-12), "angular": within(1e-12)},
        fine=[{"variant": "updated", "periods": 20}],
    ),
    Known(
        "hinged plate in a wind, angle [degrees]", plates.hinged_plate,
        {"error": within(1.0), "drift": within(0.4), "slip": within(0.01)},
        [{"variant": "total", "k": 0.5, "law": "projected", "cells": 4}],
        [{"variant": "total", "k": k, "law": law}
         for k, law in ((0.5, "paper"), (0.5, "projected"), (2.0, "projected"))]
        + [{"variant": "updated", "k": 0.5, "law": "paper"}],
        {"error": within(0.2)},
        page="accuracy.md",
    ),
    Known(
        "plate that bends in a flow, drag", reconfiguration.reconfiguration, {"error": within(0.01)},
        [{"variant": "total", "law": law, "cauchy": 3.0, "cells": 8, "slenderness": 30.0, "settle": 10.0}
         for law in reconfiguration.POWERS],
        [{"variant": "total", "law": law, "cauchy": c, "cells": 32}
         for law in reconfiguration.POWERS for c in (1.0, 10.0, 100.0, 1000.0)]
        + [{"variant": "total", "law": law, "cauchy": 1000.0, "cells": 64, "slenderness": 80.0}
           for law in reconfiguration.POWERS],
        {"error": within(0.05), "drift": within(5e-3), "drag": (0, 0.9),
         "tip": (of("exact_tip", more=-0.05), of("exact_tip", more=0.05))},
        page="accuracy.md",
    ),
    Known(
        "inverted flag, pressure at which it diverges", divergence.divergence,
        {"error": within(0.02), "exact": near(6.330, 5e-4), "below": (-ANY, 0), "above": (0, ANY)},
        [{"variant": "total", "cells": 8, "slenderness": 30.0}],
        [{"variant": "total", "cells": 32, "slenderness": 60.0}],
        {"error": within(0.08)},
        page="accuracy.md",
    ),
    Known(
        "strip of a fabric that hangs over an edge, drop", fabrics.hanging_strip, {"error": within(0.03)},
        [{"fabric": "ponte", "cells": 6, "stretch": 20.0, "settle": 6.0}],
        [{"variant": "total, float32", "fabric": fabric, "stretch": 1000.0, "cells": 16, "layers": layers}
         for fabric in fabrics.FABRICS for layers in (3, 1)],
        {"error": within(0.06), "residual": within(0.02), "span": (0.4, 1.0)},
    ),
    Known(
        # flat patches on a sphere are off by (spacing / radius)², which is 4 pi / 500 with 500 Gaussians
        "drag on a surface of Gaussians with areas `coverage`", surfaces.surface_drag, {"error": within(0.025)},
        [{"shape": "sphere", "law": "paper", "count": 500, "overlap": 0.5, "area": "coverage"}],
        [{"shape": shape, "law": "paper", "count": n, "overlap": o, "area": "coverage"}
         for shape in ("plate", "sphere") for n, o in ((500, 0.5), (2000, 0.3), (2000, 1.0))],
        page="accuracy.md",
    ),
    Known(
        "angles of friction of the law for sand [degrees]", _angles,
        {"shear_deg": near(34.72, 0.06), "triaxial_deg": near(30, 0.06), "plane_strain_deg": near(43.85, 0.06)},
        [{"friction": 30.0, "correction": c} for c in (False, True)], [{"friction": 30.0}],
    ),
    *(
        Known("angle in simple shear [degrees]", _angles, {"shear_deg": near(shear, 0.5)}, [{"friction": friction}])
        for friction, shear in ((20.0, 24.0), (40.0, 43.4))
    ),
    Known(
        "sand on an incline: where it stands and where it flows", _slopes,
        {"gain_30": within(5e-3), "speed_30": within(0.02), "gain_40": (0.05, 0.113), "speed_40": (0.15, ANY)},
        [{"variant": "updated"}],
    ),
    Known(
        "sand on an incline, angle of friction [degrees]", angle_of_repose,
        {"friction_deg": (of("exact", more=-0.5), of("exact", more=0.5)), "stands": near(34, 0), "flows": near(35, 0)},
        fine=[{"variant": "updated"}],
    ),
    Known(
        "column of sand between walls at rest", column_at_rest,
        {"error": (0, lambda r: min(1e-3, 0.3 * r["settlement"])), "kinetic": within(1e-4)}, [{}],
    ),
    Known(
        "column of sand that collapses, run-out", column_collapse,
        # Lube's and Lajeunesse's round columns differ by a factor of 1.6
        {"runout": (lambda r: lube(r["aspect"]) / 1.6, lambda r: 1.6 * lube(r["aspect"])), "lost": near(0, 0),
         "volume_ratio": near(1, 0.03)},
        fine=[{"variant": "updated", "aspect": a, "cells": 16} for a in (0.5, 1.0, 2.0, 3.0)],
        page="accuracy.md",
    ),
    Known(
        "taller and weaker columns of sand spread further", _spread,
        {"lost": near(0, 0), "volume_ratio": near(1, 0.03), "lower": (0, 0.5), "weaker": (1.2, ANY),
         "runout": (0, of("lube"))},
        [{"cells": 3, "duration": 2.0}],
    ),
    Known(
        "tossed sand keeps its volume, with the correction", _tossed,
        {"highest": (1.1, ANY), "error": within(0.02), "gaps": (0.1, ANY)}, [{"cells": 3, "seconds": 0.25}],
    ),
    Known(
        "soft flag in `total`: torn or lost points", _soft_flag, {"torn": near(0, 0), "lost": near(0, 0)},
        fine=[{"variant": "total, float32", "dx": dx, "density": d} for dx in (0.04, 0.01) for d in (20.0, 50.0)],
    ),
    Known(
        "tree, frequency beside that of a frame of beams", trees.frequency, {"error": within(0.05)},
        [{"leaf_area": 30.0, "dx": 0.5, "height": 6.0, "branches": 2}],
        [{"leaf_area": a, "dx": dx} for a in (0.0, 180.0) for dx in (1.0, 0.5, 0.25)],
        {"error": within(0.15), "leaves": near(6.0, 0.3)},
        page="accuracy.md",
    ),
    Known(
        "tree, damping ratio beside that of its mode", trees.damping, {"error": within(0.05)},
        [{"leaf_area": 30.0, "pull": 0.2, "dx": 1.0, "periods": 1.0, "height": 6.0, "branches": 1}],
        [{"leaf_area": a, "pull": 1.2, "breeze": 0.0, "dx": dx} for dx in (0.5, 0.25) for a in (0.0, 180.0)],
        {"error": within(0.3), "exact": (0.051, ANY)},
    ),
    Known(
        "crown, drag at 25 m/s beside elasticas', and how it grows", crowns.crown,
        {"error": within(0.05), "exponent": (of("known", more=-0.15), of("known", more=0.15))},
        [{"species": "birch", "speeds": (10.0, 20.0), "cells": 5, "branches": 2, "settle": 6.0}],
        [{"species": species, "cells": n} for species in crowns.CROWNS for n in (8, 16)],
        {"error": within(0.12), "R_10": (of("R_20"), 0.7),
         "exponent": (of("elastica", more=-0.15), of("elastica", more=0.15))},
        page="accuracy.md",
    ),
    Known(
        "plate that falls, speed at any time", falling.fall,
        {"error": within(2e-3), "turned": within(1e-3)},
        [{"law": law, "tilt": tilt, "cells": 4, "settle": 1.5}
         for law, tilt in (("projected", 0.0), ("projected", 40.0), ("cross_flow", 40.0))],
        [{"law": law, "tilt": tilt} for law in ("projected", "cross_flow") for tilt in (0.0, 30.0, 60.0)],
        {"turned": within(1e-6),
         "along": (lambda r: _slid(r) - 1e-6, lambda r: _slid(r) + 1e-6)},
        page="accuracy.md",
    ),
    Known(
        "plate that falls and turns, decay of its spin", falling.fall, {"error": within(0.02)},
        [{"spin": 0.2, "cells": 8, "settle": 1.5}], [{"law": "cross_flow", "spin": 0.2, "cells": 32}],
        {"error": (-0.09, 0)},
    ),
    Known(
        "fabric over a disc, drape coefficient beside a shell's", drapes.drape,
        {"error": within(0.1), "weight": near(1, 2e-3), "folds_found": (of("folds"), of("folds"))},
        [{"fabric": "denim", "folds": f, "cells": 4, "settle": 5.0, "layers": n} for n, f in ((3, 4), (1, 5))],
        [{"fabric": fabric, "folds": 5, "cells": n} | layers
         for fabric in drapes.SHELL for n in (6, 8) for layers in ({}, {"layers": 1})],
        {"error": within(0.2)},
        page="accuracy.md",
    ),
    Known(
        "wrinkles of a stretched sheet, wavelength beside a shell's", wrinkles.wrinkles,
        {"error": within(0.1), "stretched": near(0.05, 0.0025)},
        fine=[{"bending": 2e-7, "cells": n} for n in (32, 48, 64, 80)]
        + [{"bending": 2e-7, "cells": n, "layers": 1} for n in (32, 48)],
        page="accuracy.md",
    ),
    Known(
        "a sheet on few cells is too stiff to wrinkle", wrinkles.wrinkles,
        {"stretched": near(0.05, 0.0025), "wavelength": near(0, 0), "amplitude": (0, 0.5)},
        [{"bending": 1e-7, "cells": 8, "rest": 2.0}],
    ),
    Known(
        "vortices that decay in the air", air.taylor_green, {"error": within(1e-3), "order": SECOND},
        [{"cells": (16, 32)}], [{"cells": (32, 64)}], {"order": (1.6, ANY)}, "air.md",
    ),
    Known(
        "flow between walls", air.poiseuille, {"error": within(lambda r: 0.77 / _last(r) ** 2), "order": near(2, 0.02)},
        [{"cells": (6, 12)}], [{"cells": (8, 16)}], page="air.md",
    ),
    Known(
        "cavity with a moving lid, beside Ghia and others", air.cavity, {"error": within(0.01)},
        [{"cells": 32}], [{"cells": n} for n in (32, 64, 96)], {"error": within(0.015)}, "air.md",
    ),
    Known(
        "bubble behind a step at Re 100, 2.92 steps long (Erturk 2008)", air.step, {"bubble": near(2.92, 0.4)},
        [{"cells": 10, "reynolds": 100.0, "until": 15.0}],
    ),
    Known(
        "bubble behind a step at Re 200, 4.98 steps long (Erturk 2008)", air.step, {"bubble": near(4.98, 0.25)},
        fine=[{"cells": n} for n in (20, 40)], page="air.md",
    ),
    Known(
        "drag of a square plate across the flow, 1.2 to 1.3", air.plate, {"drag": (1.08, 1.43)},
        fine=[{"cells": n} for n in (10, 20, 40)], page="air.md",
    ),
    Known("lift of a plate that heaves in an ideal flow", flutter.heaving, {"error": within(0.015)}, [{"kappa": 3.0}]),
    Known(
        "air's damping of a plate that moves up and down, per that of theory (Theodorsen 1935)", flutter.heaving_in_air,
        {"damping": near(1, 0.1), "mass": near(1, 0.1)}, fine=[{"cells": n} for n in (24, 48)], page="air.md",
    ),
    Known(
        "wind at which a clamped flag flutters, per that of linear theory", flutter.onset, {"speed": near(1, 0.15)},
        [{"mass_ratio": 1.0, "cells": 12}],
        [{"mass_ratio": m, "cells": n} for m in (0.5, 1.0) for n in (24, 48)], {"speed": (0.7, 1.15)}, "air.md",
    ),
    Known(
        "Strouhal number of a cylinder at Re 100, 0.1645 (Williamson 1989)", air.cylinder,
        {"strouhal": near(0.1645, 0.005)}, fine=[{"cells": n} for n in (12, 24)], page="air.md",
    ),
    Known(
        "drag of a sphere at Re 100, 1.09 (Clift and others 1978)", air.sphere, {"drag": near(1.09, 0.033)},
        fine=[{"cells": 16, "length": 18, "width": 12}, {"cells": 24, "length": 18, "width": 12}], page="air.md",
    ),
    Known(
        "square flag: amplitude 0.78, frequency 0.26 (Huang and Sung 2010)", air.square_flag,
        {"amplitude": near(0.78, 0.078), "frequency": near(0.26, 0.026)},
        fine=[{"cells": n, "width": 8} for n in (24, 32, 48)], page="air.md",
    ),
    Known(
        "plate in computed air begins to fall freely", _falls,
        # m g = 1/2 moves the plate, of mass 100, and the air that it pushes, pi / 4
        {"speed": near(0.375 * 0.5 / (100 + math.pi / 4), 0.02 * 0.375 * 0.5 / 100.8), "swing": within(1e-4)},
        [{"froude": 10.0, "cells": 10, "until": 0.5, "side": 6, "tilt": 0.0}],
    ),
    Known(
        "light plate in computed air swings from side to side", _both_ways,
        {"turns": (0, 0.3), "swing": (0.4, ANY), "speed": (0.3, 1.0), "mirrored": within(0.02)},
        [{"froude": 0.3, "cells": 10, "until": 7.0, "side": 6}],
    ),
    Known(
        "plate in computed air flutters at a Froude number of 0.3 (Belmonte and others 1998)", _falls,
        {"turns": (0, 0.3)}, fine=[{"froude": 0.3}], page="air.md",
    ),
    Known(
        "plate at a Froude number of 0.5 flutters, too, from other angles, on other cells, at other Reynolds numbers",
        _falls, {"turns": (0, 0.3)},
        fine=[
            {"froude": 0.5} | other
            for other in (
                {}, {"tilt": 0.8}, {"tilt": 0.1}, {"reynolds": 200.0}, {"reynolds": 1500.0}, {"cells": 16},
                {"cells": 36},
            )
        ],
        page="air.md",
    ),
    Known(
        "plate in computed air tumbles from a Froude number of 0.67 on (Belmonte and others 1998)", _falls,
        {"turns": (2.0, ANY)}, fine=[{"froude": f} for f in (0.9, 1.2)], page="air.md",
    ),
]  # fmt: skip
"""All problems."""


def _last(results: Row) -> int:
    cells = results["cells"]
    return cells[-1] if isinstance(cells, (tuple, list)) else cells


def _slid(results: Row) -> float:
    """Speed along a tilted plate, which no air slows [m/s]."""
    return falling.GRAVITY * math.sin(math.radians(results["tilt"])) * results["simulated_s"]


def plain(parameters: Row) -> Row:
    """Parameters as they are read from a record."""
    read: Row = json.loads(json.dumps(parameters))
    return read


def _grid(device: str) -> list[Row]:
    del device
    return [{"problem": one.name, **plain(parameters)} for one in KNOWN for parameters in one.fine]


@study("known", _grid)
def measured(problem: str, device: str = "cpu", **parameters: Any) -> Row:
    """The results of a problem of this name."""
    return next(one for one in KNOWN if one.name == problem).measure(device, **parameters)
