"""Tables of ``bench.py pareto``."""

from __future__ import annotations

import statistics
from typing import Any

from bench.cases.pareto import DEFAULT, PROBLEMS, PROVEN_CFL, is_default, on_front, proven
from bench.slots import table, value
from bench.tables.markdown import grid, measured, stack, yes_no

Row = dict[str, Any]
PAGE = "validation.md"


@value("pareto.proven_cfl", "pareto_*")
def proven_cfl(_: Row) -> str:
    """The largest CFL number that is proven stable for any arrangement of particles."""
    return f"{PROVEN_CFL}"


@table(PAGE, "pareto.device", "pareto_*")
def device(result: Row) -> list[str]:
    """The device of the sweep, and what else ran at the time."""
    lines = [f"{result['device']}; {stack(result)}; {result['threads']} thread(s).{measured(result)}"]
    return [*lines, "", f"Recorded with {result['concurrent']}."] if "concurrent" in result else lines


@table(PAGE, "pareto.cheapest", "pareto_*")
def cheapest(result: Row) -> list[str]:
    """The cheapest proven setting for each problem and accuracy, compared with the default."""
    head = ["problem", "size", "cheapest proven setting at least as accurate as the default", "error"]
    head += ["default's error", "its time [s/s]", "default's time [s/s]"]
    head += ["default on the front of proven settings", "of all settings"]
    rows = []
    for problem, (_, unit, _) in PROBLEMS.items():
        own = [row for row in result["rows"] if row["problem"] == problem]
        safe = [row for row in own if proven(row)]
        for default in (row for row in own if is_default(row) and row["error"]):
            as_good = [row for row in safe if row["error"] and row["error"] <= default["error"]]
            best = min(as_good, key=lambda r: r["wall_per_simulated_s"])
            step = f"CFL {best['cfl']}" if best["cfl"] else f"substep {best['substep']:.2g} s"
            rows.append(
                [
                    problem,
                    f"{default['size']} {unit}",
                    f"`{best['variant']}`, {best['dtype']}, {step}, {unit} {best['size']}",
                    *(f"{row['error']:.2e}" for row in (best, default)),
                    *(f"{row['wall_per_simulated_s']:.3g}" for row in (best, default)),
                    *(yes_no(on_front(default, rivals)) for rivals in (safe, own)),
                ]
            )
    return grid(head, rows)


@value("pareto.on_front", "pareto_*")
def default_on_front(result: Row) -> str:
    """The number of grids on which the default is on the front of the proven settings."""
    found = [row for row in result["rows"] if is_default(row) and row["error"]]
    safe = [row for row in result["rows"] if proven(row)]
    good = sum(on_front(row, [other for other in safe if other["problem"] == row["problem"]]) for row in found)
    return f"{good} of {len(found)}"


@value("pareto.time_at", "pareto_*")
def time_at(result: Row, cfl: str) -> str:
    """Time with another CFL number divided by that with the default: the median over otherwise equal runs."""
    times: dict[Any, dict[float, float]] = {}
    for row in result["rows"]:
        if row["error"] and row["substep"] is None and row["dtype"] == DEFAULT["dtype"]:
            alike = times.setdefault((row["problem"], row["size"], row["variant"]), {})
            alike[row["cfl"]] = row["wall_per_simulated_s"]
    ratios = [
        own[float(cfl)] / own[DEFAULT["cfl"]] for own in times.values() if {float(cfl), DEFAULT["cfl"]} <= set(own)
    ]
    return f"{statistics.median(ratios):.2f}"


@table(PAGE, "pareto.adaptive", "pareto_*")
def adaptive(result: Row) -> list[str]:
    """The adaptive substep compared with PhysGaussian's fixed one, on the flag, by their numbers."""
    head = ["flag, dx [m]", "substeps, adaptive, CFL 0.4", "substeps of 1e-4 s", "times as many", "error"]
    head += ["error of the fixed substep", "difference (share of the longer side)"]
    flag = [row for row in result["rows"] if row["problem"] == "flag"]
    flag = [row for row in flag if row["variant"] == "total" and row["dtype"] == "float32"]
    rows = []
    for row in (r for r in flag if is_default(r)):
        for fixed in (r for r in flag if r["substep"] and r["size"] == row["size"] and r["error"] and row["error"]):
            counts, errors = ([r[name] for r in (row, fixed)] for name in ("substeps", "error"))
            rows.append(
                [
                    str(row["size"]),
                    *(f"{count:,.0f}" for count in counts),
                    f"{counts[1] / counts[0]:.1f}",
                    *(f"{error:.4f}" for error in errors),
                    f"{abs(errors[0] - errors[1]):.5f}",
                ]
            )
    return grid(head, rows)
