"""The plots of ``bench.py speed``: time and memory of a substep against the number of particles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.tables.figure import save_figure

Row = dict[str, Any]


def draw(results: list[Row], pictures: Path) -> None:
    """Draw ``speed_<kind>.png`` for each record that has rollouts."""
    for result in results:
        if any("failed" not in row for row in result.get("substep", []) + result.get("sand", [])):
            _plot(result, pictures / f"speed_{result['kind']}.png")


def _plot(result: Row, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    sheets = [row for row in result.get("substep", []) if "failed" not in row]
    sand = [row for row in result.get("sand", []) if "failed" not in row]
    with_memory = any(row["memory_bytes"] is not None for row in sheets + sand)
    figure, grid = plt.subplots(
        1, 1 + with_memory, figsize=(6.5 + 5 * with_memory, 5.4), layout="constrained", squeeze=False
    )
    axes = grid[0]

    def draw(axis: Any, rows: list[Row], value: Callable[[Row], float | None], **style: Any) -> None:
        pairs = [(row["particles"], value(row)) for row in rows]
        pairs = sorted((n, v) for n, v in pairs if v is not None and v > 0)
        if pairs:
            axis.loglog(*zip(*pairs, strict=True), **style)

    copy = result["copy"]["bytes_per_s"]
    star = {"color": "tab:brown", "marker": "*", "markersize": 11, "linestyle": "", "label": "updated, sand: rollout"}
    for name, color in (("total", "tab:blue"), ("updated", "tab:orange")):
        rows = sorted((r for r in sheets if r["formulation"] == name), key=lambda r: r["particles"])
        whole = {"color": color, "marker": "o", "label": f"{name}: rollout"}
        draw(axes[0], rows, lambda r: r["median_ms"], **whole)
        low, high = ([row[f"quartile_{end}_ms"] for row in rows] for end in ("low", "high"))
        axes[0].fill_between([row["particles"] for row in rows], low, high, color=color, alpha=0.2, linewidth=0)
        draw(axes[0], rows, lambda r: r["graph_ms"], color=color, linestyle="--", label=f"{name}: slope")
        own = {"color": color, "marker": "s", "markerfacecolor": "none", "linestyle": "-.", "linewidth": 0.8}
        draw(axes[0], rows, lambda r: (r["torch"] or {}).get("median_ms"), **own, label=f"{name}: transfer torch")
        floor = {"color": color, "linestyle": ":", "label": f"{name}: fewest bytes at the copy's bandwidth"}
        draw(axes[0], rows, lambda r: 1e3 * r["bytes"] / copy, **floor)
        if name == "total":  # gives each formulation its own column in the legend
            draw(axes[0], sand, lambda r: r["median_ms"], **star)
        if with_memory:
            draw(axes[1], rows, lambda r: (r["memory_bytes"] or 0) / 2**20, color=color, marker="o")
    axes[0].set_ylabel("time of a substep [ms]")
    if with_memory:
        draw(axes[1], sand, lambda r: (r["memory_bytes"] or 0) / 2**20, **star)
        axes[1].set_ylabel("peak device memory [MiB]")
    for axis in axes:
        axis.set_xlabel("particles N")
        axis.grid(True, which="major", linewidth=0.4, alpha=0.6)
    figure.suptitle(f"{result['device']}, sheet in wind", fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)
    save_figure(figure, path)
