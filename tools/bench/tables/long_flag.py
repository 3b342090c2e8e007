"""Table and findings of the long flag, which a slow test of tests/problems/test_hard_cases.py records."""

from __future__ import annotations

import math
from typing import Any

from bench.slots import table, value
from bench.tables.markdown import grid, measured, stack

Row = dict[str, Any]
MADE = (
    "Recorded by `GAUSSIAN_SWAYING_RECORD=docs/results python -m pytest -m slow tests/problems/test_hard_cases.py "
    "-k ten_minutes`."
)


@table("validation.md", "long_flag.minutes", "long_flag")
def minutes(found: Row) -> list[str]:
    """Energies of each minute, with and without damping."""
    head = ["damping [1/s]", "mechanical energy of each minute [J]", "kinetic energy of the particles [J]"]
    head += ["largest stretch", "torn", "lost", "substeps", "seconds"]
    runs = [run for name, run in found.items() if name != "measured"]
    rows = [
        [
            str(run["damping_per_s"]),
            *(
                ", ".join(f"{energy:.3g}" for energy in run["energy_per_minute_J"][name])
                for name in ("mechanical", "kinetic_of_particles")
            ),
            f"{run['largest_stretch']:.2f}",
            str(run["torn"]),
            str(run["lost"]),
            f"{run['substeps']:,}",
            f"{run['wall_s']:.0f}",
        ]
        for run in runs
    ]
    told = [f"{runs[0]['device']}; {stack(runs[0])}.{measured(found)} {MADE}", "", *grid(head, rows)]
    return [*told, "", *grid(["goal", "wanted", "where this comes from", "measured", "reached"], goals(runs))]


def goals(runs: list[Row]) -> list[list[str]]:
    """Energies of the tenth minute against the second, in standard errors of the difference."""
    lines = []
    for run in runs:
        for name, told in (
            ("kinetic_of_particles", "kinetic energy of the particles"),
            ("mechanical", "mechanical energy"),
        ):
            energy, error = (run[f"{part}_per_minute_J"][name] for part in ("energy", "standard_error"))
            rise = (energy[9] - energy[1]) / math.hypot(error[9], error[1])
            goal = f"damping {run['damping_per_s']:g} 1/s: {told} in the tenth minute no higher than in the second"
            why = "gusts are stationary; one of 30,000 such differences is larger by chance"
            lines.append(
                [goal, "rise of at most 4 standard errors", why, f"{rise:+.1f}", "yes" if rise <= 4 else "**no**"]
            )
    return lines


@value("long_flag.growth", "long_flag")
def growth(found: Row, run: str) -> str:
    """Growth of the mechanical energy per minute, from a linear fit of its logarithm."""
    logarithms = [math.log(energy) for energy in found[run]["energy_per_minute_J"]["mechanical"]]
    middle, mean = (len(logarithms) - 1) / 2, sum(logarithms) / len(logarithms)
    slope = sum((k - middle) * (y - mean) for k, y in enumerate(logarithms))
    slope /= sum((k - middle) ** 2 for k in range(len(logarithms)))
    return f"{100 * math.expm1(slope):.1f} %"


@value("long_flag.damping", "long_flag")
def damping(found: Row, run: str) -> str:
    """The damping of a run."""
    return f"{found[run]['damping_per_s']:g} 1/s"


@value("long_flag.kinetic", "long_flag")
def kinetic(found: Row, run: str, minute: str) -> str:
    """Mean kinetic energy of the particles in a minute, counted from 1."""
    return f"{found[run]['energy_per_minute_J']['kinetic_of_particles'][int(minute) - 1]:.3g} J"
