"""The plot of ``bench.py accuracy``: error against cells."""

from __future__ import annotations

from pathlib import Path

from bench.cases.accuracy import SINGLE, VARIANTS
from bench.tables.figure import save_figure
from bench.tables.rows import Row, select


def draw(results: list[Row], pictures: Path) -> None:
    """Draw ``convergence.png`` from the rows of all records."""
    _plot([row for result in results for row in result["rows"]], pictures / "convergence.png")


def _plot(rows: list[Row], path: Path) -> None:
    """Error against cells, log-log, for the problems with an order."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = {
        "confined bar (frequency)": ("vibrating bar", {"ends": "free"}),
        "bar held at points (frequency)": ("bar held at points", {}),
        "bar held by nodes (frequency)": ("vibrating bar", {"ends": "fixed-free"}),
        "hanging bar (tip)": ("hanging bar", {"clamp": "mirror"}),
        "vortex (displacement)": ("vortex", {}),
    }
    figure, axes = plt.subplots(1, 5, figsize=(16, 3.4), layout="constrained")
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
    save_figure(figure, path)
