"""``bench.py refinement``: whether a finer grid is closer to Blender's cloth, on every flag that has a reference."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

from bench.case import NOTE, Case, Measurement, numbers, option
from bench.cases.blender import Run, apart, reference, version
from bench.cases.flags import REFERENCES, Flag, flags_named
from bench.clock import guarded
from bench.record import Row

from flag_motion import Cloth  # isort: skip  `flags` has added the folder of the data sets
from flag_reference import FlagPattern, least_quality  # isort: skip

RIPPLE = 0.003
"""Amplitude of the ripple of splats made in code [m], which a reference at rest may lack."""
UNEVEN: Flag = "pennant"
"""The flag that is also solved with that ripple."""
DISTANCE = 0.005
"""Distance that a cloth with self-contact keeps from itself, on both sides [m]."""


@dataclass(frozen=True)
class Rippled(Run):
    """A flag that is flat in its reference, with :data:`RIPPLE`."""

    def flag(self) -> FlagPattern:
        """See :meth:`Run.flag`."""
        return replace(super().flag(), ripple=RIPPLE)

    def arguments(self) -> list[str]:
        """See :meth:`Run.arguments`."""
        return [*super().arguments(), f"--scene.generator.init_args.ripple={RIPPLE}"]


@dataclass(frozen=True)
class OneLayer(Run):
    """A flag of one layer of points that bends by itself."""

    def arguments(self) -> list[str]:
        """See :meth:`Run.arguments`."""
        return [*super().arguments(), "--scene.layers=1", "--material.bending=plate"]


@dataclass(frozen=True)
class Touching(Run):
    """A flag with self-contact at :data:`DISTANCE`, without friction."""

    def flag(self) -> FlagPattern:
        """See :meth:`Run.flag`."""
        flag = replace(super().flag(), self_collision=True, self_distance=DISTANCE)
        return flag if self.solver == "ours" else replace(flag, quality=least_quality(flag))

    def arguments(self) -> list[str]:
        """See :meth:`Run.arguments`."""
        return [*super().arguments(), f"--contact.thickness={DISTANCE}", "--contact.friction=0"]


def _distance(run: Run, options: argparse.Namespace, to: Cloth, flat: Cloth | None = None) -> Row:
    """Solve a flag by ours, and compare it with its reference; one with the ripple with a ``flat`` one, too."""
    positions, found = run.solve(options.blender)
    ours = run.cloth(positions)
    found |= apart(run.flag(), ours, to)
    return found if flat is None else found | {"to_flat": apart(run.flag(), ours, flat)}


def _turns(pattern: Flag, cells: int, options: argparse.Namespace) -> Row:
    """Seconds of three layers and of one, which take turns, and how they compare in each turn."""
    kinds = {
        "three": Run(pattern, "ours", cells, options.frames),
        "one": OneLayer(pattern, "ours", cells, options.frames),
    }
    times: dict[str, list[float]] = {name: [] for name in kinds}
    for turn in range(options.rounds + 1):  # the first compiles the kernels
        for name, run in kinds.items():
            seconds = run.solve(options.blender)[1]["seconds"]
            if turn:
                times[name].append(seconds)
    ratios = [one / three for one, three in zip(times["one"], times["three"], strict=True)]
    return {name: statistics.median(values) for name, values in times.items()} | {"ratio": statistics.median(ratios)}


def _itself(make: type[Run], pattern: Flag, options: argparse.Namespace) -> tuple[Cloth, Row]:
    """The finer of two meshes of Blender's, and how far the other is from it."""
    coarser, finer = (make(pattern, "blender", cells, options.frames) for cells in options.blender_cells)
    known = reference(finer, options)
    return known, apart(finer.flag(), reference(coarser, options), known) | {"cells": options.blender_cells}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Each flag on grids from coarse to fine; then the uneven one, on both sides and against the flat one."""
    result["versions"] = result["versions"] | {"bpy": version(options.blender)}
    kind = "turns_" if options.rounds else "touching_" if options.contact else ""
    result |= {f"{kind}frames": options.frames, "note": options.note}
    for pattern in options.flags:
        if options.rounds:
            for cells in options.grids:
                yield (
                    ("turns", {"flag": pattern, "cells": cells}),
                    partial(guarded, partial(_turns, pattern, cells, options)),
                )
            continue
        if options.contact:
            touching, about = _itself(Touching, pattern, options)
            free = reference(Run(pattern, "blender", options.blender_cells[-1], options.frames), options)
            about["to_free"] = apart(REFERENCES[pattern], touching, free)
            yield ("touching_references", str(pattern)), about.copy
            for cells in options.grids:
                work = partial(_distance, Touching(pattern, "ours", cells, options.frames), options, touching)
                yield ("touching", {"flag": pattern, "cells": cells}), partial(guarded, work)
            continue
        flat, about = _itself(Run, pattern, options)
        if options.layers == 1:
            for cells in options.grids:
                work = partial(_distance, OneLayer(pattern, "ours", cells, options.frames), options, flat)
                yield ("one_layer", {"flag": pattern, "cells": cells}), partial(guarded, work)
            continue
        yield ("references", str(pattern)), about.copy
        for cells in options.grids:
            work = partial(_distance, Run(pattern, "ours", cells, options.frames), options, flat)
            yield ("rows", {"flag": pattern, "cells": cells}), partial(guarded, work)
        if pattern == UNEVEN:
            uneven, about = _itself(Rippled, pattern, options)
            about["to_flat"] = apart(REFERENCES[pattern], uneven, flat)
            yield ("uneven", "reference"), about.copy
            for cells in options.grids:
                work = partial(_distance, Rippled(pattern, "ours", cells, options.frames), options, uneven, flat)
                yield ("uneven", str(cells)), partial(guarded, work)


CASE = Case(
    "Compare flags on finer and finer grids with Blender's cloth on a fine mesh.",
    rows,
    (
        option("--blender", "a Python that has bpy; it may have an environment of its own", default=sys.executable),
        option("--references", "folder of the motions to compare with; what it lacks is solved first",
               default="outputs/blender"),
        option("--flags", "separated by commas", type=flags_named, default=",".join(map(str, REFERENCES))),
        numbers("--blender_cells", "cells along the longer side of the reference, and of a finer one",
                default="120,160"),
        numbers("--grids", "cells of our grids along the longer side", default="30,40,60,80"),
        option("--layers", "of points: 3, or 1, which is recorded beside them", type=int, choices=(1, 3), default=3),
        option("--rounds", "only the times of three layers and of one, in so many turns", type=int, default=0),
        option("--contact", "with self-contact on both sides, recorded beside the rows without", action="store_true"),
        option("--frames", "frames, the first being the rest shape", type=int, default=125),
        NOTE,
    ),
    page="flag_benchmark.md",
    device=False,
)  # fmt: skip
