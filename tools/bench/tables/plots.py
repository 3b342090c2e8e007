"""The plots of ``bench.py accuracy``, ``pareto`` and ``speed``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.cases.accuracy import SINGLE, VARIANTS
from bench.cases.pareto import PROBLEMS, front, is_default, proven
from bench.tables.rows import Row, all_rows, select


def subplots(*shape: int, **options: Any) -> tuple[Any, Any]:
    """A figure without a window, and its axes."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(*shape, layout="constrained", **options)


def plain_numbers(axis: Any) -> None:
    """Numbers 1, 2, 5, 10 ... at logarithmic axes, without exponents."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for scale in (axis.xaxis, axis.yaxis):
        scale.set_minor_formatter(NullFormatter())
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure, with its folder, and forget it."""
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def accuracy(results: list[Row], pictures: Path) -> None:
    """Draw ``convergence.png``, error against cells for problems with an order, and ``nature.png``, from all rows."""
    rows = all_rows(results)
    panels = {
        "confined bar (frequency)": ("vibrating bar", {"ends": "free"}),
        "bar held at points (frequency)": ("bar held at points", {}),
        "bar held by nodes (frequency)": ("vibrating bar", {"ends": "fixed-free"}),
        "hanging bar (tip)": ("hanging bar", {"clamp": "mirror"}),
        "vortex (displacement)": ("vortex", {}),
    }
    figure, axes = subplots(1, 5, figsize=(16, 3.4))
    for axis, (title, (problem, parameters)) in zip(axes, panels.items(), strict=True):
        for variant, marker in zip((*VARIANTS, *SINGLE), "osd.", strict=True):
            found = sorted(select(rows, problem, variant=variant, **parameters), key=lambda r: r["parameters"]["cells"])
            cells = [row["parameters"]["cells"] for row in found]
            axis.loglog(cells, [row["result"]["error"] for row in found], marker + "-", label=variant, linewidth=1)
        low, high = axis.get_xlim()
        top = axis.get_ylim()[1]
        axis.loglog([low, high], [top, top * (low / high) ** 2], "k:", linewidth=0.8, label="order 2")
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("cells")
        axis.set_xticks([8, 16, 32, 64], ["8", "16", "32", "64"])
        axis.minorticks_off()
    axes[0].set_ylabel("relative error")
    axes[0].legend(fontsize=8)
    save_figure(figure, pictures / "convergence.png")
    _nature(rows, pictures / "nature.png")


def _nature(rows: list[Row], path: Path) -> None:
    """Draw a plate in a flow, an inverted flag and a hanging fabric beside what is exact."""
    from bench.problems.reconfiguration import elastica

    figure, (bent, inverted, fabric) = subplots(1, 3, figsize=(13, 3.8))
    cauchy = [10 ** (0.25 * k) for k in range(13)]
    for law, color in (("projected", "C0"), ("cross_flow", "C1")):
        bent.loglog(cauchy, [elastica(c, law)[0] for c in cauchy], color=color, label=f"elastica, {law}")
        found = select(rows, "plate that bends in a flow", law=law)
        for cells, marker in ((16, "x"), (32, "s"), (64, "o")):
            own = [row for row in found if row["parameters"]["cells"] == cells]
            where = [row["parameters"]["cauchy"] for row in own], [row["result"]["drag"] for row in own]
            bent.loglog(
                *where, marker, color=color, markerfacecolor="none", label=f"{cells} cells" if color == "C0" else None
            )
    bent.set(xlabel="C", ylabel="R", title="Plate that bends in a flow: drag")
    found = select(rows, "inverted flag")
    for row in sorted(found, key=lambda row: row["parameters"]["cells"]):
        rates = [row["result"]["below"], row["result"]["above"]]
        inverted.plot([0.9, 1.1], rates, "o-", label=f"{row['parameters']['cells']} cells")
    inverted.axhline(0, color="k", linewidth=0.8)
    inverted.axvline(1, color="k", linewidth=0.8, linestyle=":")
    inverted.set(xlabel="pressure over the exact one", ylabel="rate / frequency", title="Inverted flag: growth")
    for stretch, marker in ((300.0, "s"), (1000.0, "o")):
        found = select(rows, "strip of a fabric that hangs", fabric="ponte", stretch=stretch)
        found = sorted(found, key=lambda row: row["parameters"]["cells"])
        counts = [row["parameters"]["cells"] for row in found]
        drops = [row["result"]["drop"] for row in found]
        fabric.plot(counts, drops, marker + "-", label=f"E h = {stretch:g} N/m")
    for row in found[:1]:
        fabric.set_ylim(top=1.02 * row["result"]["exact"])
        fabric.axhline(row["result"]["exact"], color="k", linestyle=":", label="elastica")
    fabric.set(xlabel="cells", ylabel="drop / L", title="Hanging strip of ponte: drop of its tip")
    fabric.set_xticks([8, 16, 32])
    for axis in (bent, inverted, fabric):
        axis.title.set_fontsize(10)
        axis.legend(fontsize=8)
    save_figure(figure, path)


def pareto(results: list[Row], pictures: Path) -> None:
    """Draw ``pareto_<kind>.png`` of each record: error against time per simulated second."""
    for result in results:
        _pareto(result["rows"], pictures / f"pareto_{result['kind']}.png")


def _pareto(rows: list[Row], path: Path) -> None:
    figure, axes = subplots(2, 2, figsize=(11, 8))
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
        plain_numbers(axis)
        axis.set_ylabel("error [degrees]" if problem == "hinged plate" else "relative error")
    for variant, color in colors.items():
        axes.flat[0].plot([], [], "o", color=color, label=f"{variant}, float32 (float64: square)")
    axes.flat[0].plot([], [], "o", color="gray", alpha=0.35, label="fixed substep (pale)")
    axes.flat[0].plot([], [], "o", color="gray", markerfacecolor="none", label="CFL 0.8: beyond the proven limit")
    axes.flat[0].plot([], [], "k*", label="default")
    axes.flat[0].legend(fontsize=7)
    save_figure(figure, path)


def speed(results: list[Row], pictures: Path) -> None:
    """Draw ``speed_<kind>.png`` of each record that has rollouts: time and memory of a substep against particles."""
    for result in results:
        if any("failed" not in row for row in result.get("substep", []) + result.get("sand", [])):
            _speed(result, pictures / f"speed_{result['kind']}.png")


def _speed(result: Row, path: Path) -> None:
    sheets = [row for row in result.get("substep", []) if "failed" not in row]
    sand = [row for row in result.get("sand", []) if "failed" not in row]
    with_memory = any(row["memory_bytes"] is not None for row in sheets + sand)
    figure, grid = subplots(1, 1 + with_memory, figsize=(6.5 + 5 * with_memory, 5.4), squeeze=False)
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
