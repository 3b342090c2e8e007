"""Extreme numbers, for every number that a configuration has."""

from __future__ import annotations

import functools
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sandbox import Case
from small import SMALL

NUMBERS = ("0", "-1", "1e-30", "1e-9", "1e-3", "0.4999999", "1e3", "1e6", "1e9", "1e12", "1e30", "1e300", "nan", "inf")
NUMBERS += ("-inf", "1000000000", "60000", "9223372036854775808", "9" * 400, "-0.0", "1e-320")
CLASSES = (  # numbers of parts that are no options of their own; not the spacing, as a million Gaussians take 2 GB
    "camera.init_args.width", "camera.init_args.height", "camera.init_args.radius", "camera.init_args.fov_y",
    "camera.init_args.elevation", "shader.init_args.ambient",
)  # fmt: skip


@functools.cache
def _fields() -> dict[str, int]:
    """Options that are numbers (1) or lists of three (3)."""
    from gaussian_swaying.simulation.simulation import Simulation

    found = dict.fromkeys(CLASSES, 1)
    for action in Simulation.parser()._actions:
        kind: Any = str(getattr(action, "_typehint", None) or getattr(action, "type", None))
        if action.dest.startswith(("help", "config")) or "cls" in kind:
            continue
        if "equence[float" in kind or "list[float" in kind or "tuple[float" in kind:
            found[action.dest] = 3
        elif "float" in kind or "int" in kind:
            found[action.dest] = 1
    return found


def cases(seed: int, count: int) -> Iterator[Case]:
    """Cases from a seed: one or two options at a time."""
    for number in range(count):
        rng = random.Random(f"extreme {seed} {number}")
        given: list[str] = []
        for name in rng.sample(sorted(_fields()), rng.choice((1, 1, 1, 2))):
            values = [rng.choice(NUMBERS) for _ in range(_fields()[name])]
            given += [f"--{name}={values[0] if len(values) == 1 else '[' + ', '.join(values) + ']'}"]

        def make(folder: Path, given: list[str] = given) -> list[str]:
            return [*SMALL, *given]

        yield Case("extreme", f"{number} {' '.join(given)}"[:120], "sim", make)
