"""The plots of ``bench.py pareto``: error against time per simulated second."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.cases.pareto import PROBLEMS, front, is_default, proven
from bench.tables.figure import save_figure

Row = dict[str, Any]


def draw(results: list[Row], pictures: Path) -> None:
    """Draw ``pareto_<kind>.png`` of each record."""
    for result in results:
        _plot(result["rows"], pictures / f"pareto_{result['kind']}.png")


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
    save_figure(figure, path)
