"""Tables, the goal and the plot of ``bench.py stability``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.cases.stability import LETTERS, REFUSED, RIGHT, TOLD, WARNED, WRONG
from bench.problems.stability import SIZE
from bench.tables.plots import save_figure, subplots
from bench.tables.render import WANTED, Goal, Row, judged, table

PAGE = "stability.md"
COLORS = {RIGHT: "#5aae61", WARNED: "#fee08b", TOLD: "#f4a259", REFUSED: "#9aa5b1", WRONG: "#d7191c"}
NAMES = {RIGHT: "right", WARNED: "right, and warned", TOLD: "wrong, and warned", REFUSED: "refused, or ended with a "
         "sentence", WRONG: "wrong without a word"}  # fmt: skip


def _rows(result: Row) -> list[Row]:
    bodies = list(dict.fromkeys(row["body"] for row in result["rows"]))
    found = sorted(result["rows"], key=lambda row: (bodies.index(row["body"]), -row["dx"]))
    return [row | {"cells": SIZE / row["dx"], "counts": {k.replace(" ", "_"): v for k, v in row["counts"].items()}}
            for row in found]  # fmt: skip


table(PAGE, "stability.counts", "stability_*", _rows, """
    body = {body} | dx [m] = {dx:g} | cells along it = {cells:.1f} | runs = {runs} | right = {counts.right} |
    right, and warned = {counts.warned} | wrong, and warned = {counts.wrong_and_warned} |
    refused, or ended with a sentence = {counts.refused} | wrong without a word = {counts.wrong} |
    largest error of energy where right = {worst_right.energy:.1 %} |
    largest difference from the finest grid where right = {worst_right.grid:.0f %}
    """.replace(":.1 %", ":.1f %"), before="{source}")  # fmt: skip


def _summed(result: Row, name: str) -> Iterator[Row]:
    for body in dict.fromkeys(row["body"] for row in _rows(result)):
        found = Counter[str]()
        for row in _rows(result):
            if row["body"] == body:
                found.update(row[name])
        yield from ({"body": body, "what": what, "runs": runs} for what, runs in found.most_common())


table(PAGE, "stability.faults", "stability_*", lambda result: _summed(result, "faults"),
      "body = {body} | what is wrong, and how the run counts = {what} | runs = {runs}")  # fmt: skip
table(PAGE, "stability.said", "stability_*", lambda result: _summed(result, "said"),
      "body = {body} | what the package says (N: a number) = {what} | runs = {runs}")  # fmt: skip


def _all(result: Row) -> Iterator[Row]:
    wrong = sum(row["counts"]["wrong"] for row in _rows(result))
    yield {"runs": sum(row["runs"] for row in _rows(result)), "wrong": wrong}


table(PAGE, "stability.goals", "stability_*", judged([
    Goal("runs that are wrong without a word", "{wrong} of {runs:,}", "wrong <= 0", _all, more={"wanted": "none"}),
    ]), WANTED)  # fmt: skip


def plot(results: list[Row], pictures: Path) -> None:
    """Draw ``stability.png`` of a record: a panel for each body and grid, a square for each run."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    (result,) = results
    axes = result["axes"]
    nu, density, young, wind = (axes[name] for name in axes)
    found = _rows(result)
    bodies = list(dict.fromkeys(row["body"] for row in found))
    columns = max(sum(row["body"] == body for row in found) for body in bodies)
    figure, panels = subplots(len(bodies), columns, figsize=(3.1 * columns, 2.9 * len(bodies) + 0.6), squeeze=False)
    order = "".join(LETTERS.values())
    for panel in panels.flat:
        panel.axis("off")
    for line, body in zip(panels, bodies, strict=True):
        for panel, row in zip(line, (row for row in found if row["body"] == body), strict=False):
            panel.axis("on")
            _panel(panel, row, ListedColormap(list(COLORS.values())), order, (nu, density, young, wind))
    figure.legend(handles=[Patch(color=COLORS[word], label=NAMES[word]) for word in COLORS], ncols=5,
                  loc="outside lower center", fontsize=9)  # fmt: skip
    save_figure(figure, pictures / "stability.png")


def _panel(panel: Any, row: Row, colors: Any, order: str, axes: tuple[list[Any], ...]) -> None:
    nu, density, young, wind = axes
    high, wide = len(nu) * len(density), len(young) * len(wind)
    picture = [[order.index(letter) for letter in row["letters"][k * wide : (k + 1) * wide]] for k in range(high)]
    panel.imshow(picture, cmap=colors, vmin=-0.5, vmax=len(order) - 0.5, aspect="auto", origin="lower",
                 interpolation="nearest")  # fmt: skip
    for k in range(1, wide):
        panel.axvline(k - 0.5, color="white", linewidth=2.0 if k % len(wind) == 0 else 0.4)
    for k in range(1, high):
        panel.axhline(k - 0.5, color="white", linewidth=2.0 if k % len(density) == 0 else 0.4)
    speeds = ", ".join(f"{sum(part**2 for part in flow) ** 0.5:.0f}" for flow in wind)
    heavy = ", ".join(f"{value:g}" for value in density)
    panel.set_xticks([len(wind) * (k + 0.5) - 0.5 for k in range(len(young))], [f"{value:.0e}" for value in young])
    panel.set_yticks([len(density) * (k + 0.5) - 0.5 for k in range(len(nu))], [f"{value:g}" for value in nu])
    panel.tick_params(labelsize=7, length=0)
    last = " (reference)" if row["reference"] else ""
    panel.set_title(f"{row['body']}, {row['cells']:.0f} cells{last}", fontsize=9)
    panel.set_xlabel(f"E [Pa]; in each: wind {speeds} m/s", fontsize=7)
    panel.set_ylabel(f"nu; in each: {heavy} kg/m³", fontsize=7)
