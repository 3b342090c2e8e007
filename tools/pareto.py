"""What ``bench.py pareto`` sweeps: speed against error, for the bar, the cantilever, the hinged plate and the flag."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.validation import bars, beams, flags, plates
from gaussian_swaying.validation.settings import Settings

Row = dict[str, Any]

# per problem: sizes from coarse to fine, what they count, and the fixed substep [s]: for the flag PhysGaussian's, for
# the others about what the finest grid needs
PROBLEMS: dict[str, tuple[tuple[float, ...], str, float]] = {
    "bar": ((8, 16, 32, 64), "cells along the bar", 0.4 * 25 / 64 / 11.6),
    "cantilever": ((1, 2, 3, 4), "cells through the thickness", 0.0),
    "hinged plate": ((4, 6, 8, 12), "cells along the plate", 5e-4),
    "flag": ((0.16, 0.08, 0.0533, 0.04), "dx [m]", 1e-4),
}
FLAG = {"frames": 15, "spacing": 0.02}
REFERENCE_DX, REFERENCE_CFL = 0.0267, 0.1
FORMULATIONS = {"total": ("total", False), "updated": ("updated", False), "MLS": ("updated", True)}
CFLS = (0.1, 0.2, 0.4, 0.8)
DEFAULT = {"variant": "total", "dtype": "float32", "cfl": 0.4, "substep": None}
PROVEN_CFL = 0.47  # stable for every arrangement of particles and every Poisson's ratio (mpm/timestep.py)


def settings_of(problem: str, device: str) -> Iterator[tuple[Row, Settings]]:
    """The settings swept for a problem: every CFL number in float32, float64 at the default, a fixed substep."""
    sizes, _, fixed = PROBLEMS[problem]
    for size in sizes:
        for variant, (formulation, mls) in FORMULATIONS.items():
            base = Settings(formulation=formulation, mls=mls, dtype=torch.float32, device=device)
            coarse = size in sizes[:2]
            for cfl in CFLS:
                if problem in ("cantilever", "hinged plate") and cfl < 0.4 and not (coarse and device == "cpu"):
                    continue  # tens of thousands of substeps, for an error that the substep does not rule
                yield (
                    {"size": size, "variant": variant, "dtype": "float32", "cfl": cfl, "substep": None},
                    replace(base, cfl=cfl),
                )
            if device == "cpu" or coarse or problem in ("bar", "flag"):
                yield (
                    {"size": size, "variant": variant, "dtype": "float64", "cfl": 0.4, "substep": None},
                    replace(base, dtype=torch.float64),
                )
            if fixed and variant == "total":
                yield (
                    {"size": size, "variant": variant, "dtype": "float32", "cfl": None, "substep": fixed},
                    replace(base, substep=fixed),
                )


def run(problem: str, size: float, settings: Settings, reference: Tensor | None) -> dict[str, float]:
    """One run; its ``error`` is relative, for the hinged plate in degrees."""
    if problem == "bar":
        return bars.vibrating_bar(int(size), settings)
    if problem == "cantilever":
        return beams.cantilever(int(size), settings, slenderness=6)
    if problem == "hinged plate":
        return plates.hinged_plate(0.5, "projected", settings, cells=int(size), seconds=2.4, per_cell=3)
    result, series = flags.flag(size, settings, **FLAG)  # type: ignore[arg-type]
    assert reference is not None
    return result | {"error": flags.distance(series, reference)}


def measure(device: str, only: list[str] | None = None) -> list[Row]:
    """Sweep the problems; a run that fails is recorded with its message and an infinite error."""
    rows = []
    for problem in only or PROBLEMS:
        reference = None
        if problem == "flag":
            exact = Settings(cfl=REFERENCE_CFL, device=device)
            _, reference = flags.flag(REFERENCE_DX, exact, **FLAG)  # type: ignore[arg-type]
        first = True
        for parameters, settings in settings_of(problem, device):
            if first:  # warm up
                run(problem, parameters["size"], settings, reference)
                first = False
            row: Row = {"problem": problem} | parameters
            try:
                result = run(problem, parameters["size"], settings, reference)
                row |= {"error": abs(result["error"]), "substeps": result["substeps"]}
                row["wall_per_simulated_s"] = result["wall_s"] / result["simulated_s"]
                row["error"] = row["error"] if math.isfinite(row["error"]) else None
                row |= {k: result[k] for k in ("torn", "lost") if k in result}
            except Exception as error:
                row |= {"error": None, "failed": f"{type(error).__name__}: {error}"}
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def front(rows: list[Row]) -> list[Row]:
    """The rows that no other beats in both error and time, cheapest first."""
    good = sorted((r for r in rows if r["error"]), key=lambda r: (r["wall_per_simulated_s"], r["error"]))
    kept: list[Row] = []
    for row in good:
        if not kept or row["error"] < kept[-1]["error"]:
            kept.append(row)
    return kept


def is_default(row: Row) -> bool:
    """Whether a row was run with the default settings of the solver, whatever its grid."""
    return all(row[name] == value for name, value in DEFAULT.items())


def proven(row: Row) -> bool:
    """Whether the substep of a row is short enough for any arrangement of particles."""
    return row["cfl"] is None or row["cfl"] <= PROVEN_CFL


def on_front(row: Row, rows: list[Row], noise: float = 0.1) -> bool:
    """Whether no other row is as accurate and cheaper by more than the noise of the clock (a share)."""
    return not any(
        other["error"]
        and other["error"] <= row["error"]
        and other["wall_per_simulated_s"] < row["wall_per_simulated_s"] * (1 - noise)
        for other in rows
    )


# ---- the page


def page(results: list[dict[str, Any]], pictures: Path) -> list[str]:
    """Lines of the page from the recorded sweeps, one per device; draws a plot of each into a folder."""
    lines = [
        "Every point of the plots is one run. Solid points have a substep that is stable for any arrangement of",
        f"particles (CFL up to {PROVEN_CFL}); hollow ones are longer and happened to be stable for the regular",
        "lattices of these problems. The star is the default (`total`, float32, CFL 0.4, adaptive). The line is the",
        "Pareto front of the solid points. CFL 0.8 costs half and happens to work here; a single particle, or a sheet",
        "in an unlucky place of the grid, would be unstable with it, so it is no default.",
        "",
    ]
    for result in results:
        rows, name = result["rows"], f"pareto_{result['kind']}.png"
        stack = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
        lines += [f"### {result['device']}", "", f"{stack}; {result['threads']} thread(s).", ""]
        if "concurrent" in result:
            lines += [f"Recorded with {result['concurrent']}.", ""]
        lines += [f"![Error against time per simulated second](pictures/{name})", ""]
        _plot(rows, pictures / name)
        lines += _recommend(rows) + _ratios(rows)
    return lines


def _recommend(rows: list[Row]) -> list[str]:
    """For each problem and accuracy the cheapest proven setting, and where the default stands."""
    lines = [
        "| problem | size | cheapest proven setting that is as accurate as the default | error | default's error | its "
        "time [s/s] | default's | default on the front of the proven | of all |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for problem, (_, unit, _) in PROBLEMS.items():
        own = [row for row in rows if row["problem"] == problem]
        safe = [row for row in own if proven(row)]
        for default in (row for row in own if is_default(row) and row["error"]):
            as_good = [row for row in safe if row["error"] and row["error"] <= default["error"]]
            best = min(as_good, key=lambda r: r["wall_per_simulated_s"])
            step = f"CFL {best['cfl']}" if best["cfl"] else f"substep {best['substep']:.2g} s"
            setting = f"`{best['variant']}`, {best['dtype']}, {step}, {unit} {best['size']}"
            lines.append(
                f"| {problem} | {default['size']} {unit} | {setting} | {best['error']:.2e} | {default['error']:.2e} | "
                f"{best['wall_per_simulated_s']:.3g} | {default['wall_per_simulated_s']:.3g} | "
                f"{'yes' if on_front(default, safe) else 'no'} | {'yes' if on_front(default, own) else 'no'} |"
            )
    found = [row for row in rows if is_default(row) and row["error"]]
    safe = [row for row in rows if proven(row)]
    good = sum(on_front(row, [other for other in safe if other["problem"] == row["problem"]]) for row in found)
    lines += [
        "",
        f"The default is on the front of the proven settings in {good} of {len(found)} grids; where it is not, a",
    ]
    lines += ["coarser grid was as accurate already, or (where times fall as the grid gets finer) the load changed."]
    return [*lines, ""]


def _ratios(rows: list[Row]) -> list[str]:
    """The adaptive substep against PhysGaussian's fixed one on the flag, and what each switch costs."""
    lines = [
        "| flag, dx [m] | adaptive, CFL 0.4 [s/s] | fixed 1e-4 s [s/s] | times cheaper | error | error of the fixed | "
        "difference, share of the side |",
        "|---|---|---|---|---|---|---|",
    ]
    flag = [row for row in rows if row["problem"] == "flag" and row["variant"] == "total" and row["dtype"] == "float32"]
    for row in (r for r in flag if is_default(r)):
        for fixed in (r for r in flag if r["substep"] and r["size"] == row["size"] and r["error"] and row["error"]):
            ratio = fixed["wall_per_simulated_s"] / row["wall_per_simulated_s"]
            lines.append(
                f"| {row['size']} | {row['wall_per_simulated_s']:.3g} | {fixed['wall_per_simulated_s']:.3g} "
                f"| {ratio:.1f} | {row['error']:.4f} | {fixed['error']:.4f} "
                f"| {abs(row['error'] - fixed['error']):.5f} |"
            )
    return [*lines, ""]


def _plot(rows: list[Row], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    colors = {"total": "tab:blue", "updated": "tab:orange", "MLS": "tab:green"}
    for axis, (problem, (sizes, unit, _)) in zip(axes.flat, PROBLEMS.items(), strict=True):
        own = [row for row in rows if row["problem"] == problem and row["error"]]
        for row in own:
            color = colors[row["variant"]]
            axis.loglog(
                row["wall_per_simulated_s"],
                row["error"],
                marker="o" if row["dtype"] == "float32" else "s",
                markersize=4 + 2 * list(sizes).index(row["size"]),
                color=color,
                markerfacecolor=color if proven(row) else "none",
                alpha=0.35 if row["substep"] else 0.8,
                linestyle="",
            )
        for row in (r for r in own if is_default(r)):
            axis.loglog(row["wall_per_simulated_s"], row["error"], "k*", markersize=9)
        best = front([row for row in own if proven(row)])
        axis.loglog([r["wall_per_simulated_s"] for r in best], [r["error"] for r in best], "k-", linewidth=0.8)
        shown = ", ".join(str(size) for size in sizes)
        axis.set_title(f"{problem} ({unit}: {shown})", fontsize=9)
        axis.set_xlabel("seconds per simulated second (larger markers: finer grids)")
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_minor_formatter(NullFormatter())
            scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        axis.set_ylabel("error [degrees]" if problem == "hinged plate" else "relative error")
    for variant, color in colors.items():
        axes.flat[0].plot([], [], "o", color=color, label=f"{variant}, float32 (float64: square)")
    axes.flat[0].plot([], [], "o", color="gray", alpha=0.35, label="fixed substep (pale)")
    axes.flat[0].plot([], [], "o", color="gray", markerfacecolor="none", label="CFL 0.8: beyond the proven limit")
    axes.flat[0].plot([], [], "k*", label="default")
    axes.flat[0].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
