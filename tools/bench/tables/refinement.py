"""Tables and the plot of ``bench.py refinement``: the distance of each flag from its reference, grid by grid."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bench.tables.flag_benchmark import named
from bench.tables.plots import plain_numbers, save_figure, subplots
from bench.tables.render import GOAL, Goal, Row, judged, table

PAGE = "flag_benchmark.md"


def _fronts(result: Row) -> Iterator[tuple[int | str, float, list[Row]]]:
    """Of each flag that has rows: its name, how well the reference knows itself, and its rows from coarse to fine."""
    rows = [row for row in result["rows"] if "failed" not in row]
    for flag in sorted({row["flag"] for row in rows}, key=str):
        own = sorted((row for row in rows if row["flag"] == flag), key=lambda row: row["cells"])
        yield flag, result["references"][str(flag)]["chamfer"], own


def _rows(result: Row) -> list[Row]:
    """By cells first, as the columns of the table are in the order of the rows."""
    rows = [{"flag": named(flag), "itself": itself, "cells": row["cells"], "chamfer": row["chamfer"]}
            for flag, itself, own in _fronts(result) for row in own]  # fmt: skip
    return sorted(rows, key=lambda row: row["cells"])


table(PAGE, "refinement.rows", "refinement_*", _rows,
      "flag = {flag} | *{cells} cells = {chamfer:.2f %} | reference against itself = {itself:.2f %}",
      before="{source}\n\nThe first {frames} frames. Cells along the longer side.[[ {note}]]")  # fmt: skip


def _worse(result: Row) -> Iterator[Row]:
    """Of each flag, by how much its distance grows at most from a grid to a finer one, and its last distance."""
    for flag, itself, own in _fronts(result):
        distances = [row["chamfer"] for row in own]
        grown = [fine - min(distances[:k]) for k, fine in enumerate(distances) if k]
        last = {"cells": own[-1]["cells"], "last": distances[-1], "most": max(0.02, itself)}
        yield {"flag": named(flag), "itself": itself, "grown": max(0.0, *grown)} | last


table(PAGE, "refinement.goals", "refinement_*", judged([
    Goal("{flag}: no grid is farther than a coarser one by more than the reference from itself",
         "{grown:.2f %} (reference itself: {itself:.2f %})", "grown <= itself"),
    Goal("{flag}: within 2 %, or the reference's own distance, on {cells} cells", "{last:.2f %}", "last <= most"),
    ], _worse), GOAL)  # fmt: skip


def _times(result: Row) -> Iterator[Row]:
    """Of each flag the coarsest grid within 2 %, or the reference's own distance, beside the finest."""
    for flag, itself, own in _fronts(result):
        enough = next((row for row in own if row["chamfer"] <= max(0.02, itself)), None)
        last = {"flag": named(flag), "finest": own[-1]["cells"], "fine_points": own[-1]["points"]}
        last["fine_seconds"] = own[-1]["seconds"]
        yield last | {name: enough and enough[name] for name in ("cells", "points", "seconds")}


table(PAGE, "refinement.times", "refinement_*", _times, """
    flag = {flag} | cells of the coarsest grid within 2 % = {cells} | points = {points:,.0f} |
    time [s] = {seconds:.0f} | finest grid [cells] = {finest} | its points = {fine_points:,.0f} |
    its time [s] = {fine_seconds:.0f}
    """)  # fmt: skip


def _uneven(result: Row) -> Iterator[Row]:
    found = result.get("uneven", {})
    for name, row in found.items():
        if "failed" not in row:
            by = "Blender's finer mesh" if name == "reference" else f"ours, {name} cells"
            yield {"by": by, "chamfer": None if name == "reference" else row["chamfer"], "to_flat": row["to_flat"]}


table(PAGE, "refinement.uneven", "refinement_*", _uneven, """
    with the ripple = {by} | distance to the reference with the ripple = {chamfer:.2f %} |
    distance to the flat reference = {to_flat.chamfer:.2f %}
    """)  # fmt: skip


def _one_layer(result: Row) -> Iterator[Row]:
    """The rows of one layer beside those of three."""
    three = {(row["flag"], row["cells"]): row for row in result["rows"] if "failed" not in row}
    rows = [row for row in result.get("one_layer", []) if "failed" not in row]
    for row in sorted(rows, key=lambda row: (str(row["flag"]), row["cells"])):
        other = three.get((row["flag"], row["cells"]), {})
        more = {f"three_{name}": other.get(name) for name in ("points", "chamfer")}
        yield {name: row[name] for name in ("cells", "points", "chamfer")} | {"flag": named(row["flag"])} | more


table(PAGE, "refinement.one_layer", "refinement_*", _one_layer, """
    flag = {flag} | cells = {cells} | points of one layer = {points:,.0f} | distance = {chamfer:.2f %} |
    points of three layers = {three_points:,.0f} | their distance = {three_chamfer:.2f %}
    """)  # fmt: skip


def _turns(result: Row) -> Iterator[Row]:
    """Times of three layers and of one, by flag and grid."""
    for row in sorted(result.get("turns", []), key=lambda row: (str(row["flag"]), row["cells"])):
        if "failed" not in row:
            yield row | {"flag": named(row["flag"])}


table(PAGE, "refinement.turns", "refinement_*", _turns, """
    flag = {flag} | cells = {cells} | three layers [s] = {three:.1f} | one layer [s] = {one:.1f} |
    one over three, median of the turns = {ratio:.2f}
    """, empty="", before="Their times, by turns, of the first {turns_frames} frames:")  # fmt: skip


def _touching(result: Row) -> Iterator[Row]:
    """The rows with self-contact beside those without."""
    free = {(row["flag"], row["cells"]): row for row in result["rows"] if "failed" not in row}
    rows = [row for row in result.get("touching", []) if "failed" not in row]
    for row in sorted(rows, key=lambda row: (str(row["flag"]), row["cells"])):
        known = result["touching_references"][str(row["flag"])]
        more = {"itself": known["chamfer"], "to_free": known["to_free"]["chamfer"]}
        more["free"] = free.get((row["flag"], row["cells"]), {}).get("chamfer")
        yield {name: row[name] for name in ("cells", "chamfer")} | {"flag": named(row["flag"])} | more


table(PAGE, "refinement.touching", "refinement_*", _touching, """
    flag = {flag} | cells = {cells} | distance, both with self-contact = {chamfer:.2f %} |
    both without = {free:.2f %} | reference with self-contact against itself = {itself:.2f %} |
    reference with self-contact against that without = {to_free:.2f %}
    """, empty="", before="With self-contact at 5 mm, without friction, on both sides, in the "
    "first {touching_frames} frames; without it in the first {frames}:")  # fmt: skip


def plot(results: list[Row], pictures: Path) -> None:
    """Draw ``refinement.png`` of a record: distance against cells, and against time, a line for each flag."""
    (result,) = results
    figure, (axis, times) = subplots(1, 2, figsize=(13, 5), sharey=True)
    for number, (flag, itself, own) in enumerate(_fronts(result)):
        colour, cells = f"C{number}", [row["cells"] for row in own]
        distances = [100 * row["chamfer"] for row in own]
        axis.plot(cells, distances, "o-", color=colour)
        times.plot(
            [row["seconds"] for row in own],
            distances,
            "o-",
            color=colour,
            label=f"{named(flag)} (reference: {100 * itself:.2f} %)",
        )
        axis.plot(1.03 * cells[-1], 100 * itself, "_", color=colour, markersize=14)
    axis.set_ylim(bottom=0)
    axis.set_xlabel("cells along the longer side")
    axis.set_ylabel("distance [% of the longer side]")
    axis.set_title("Dashes on the right: the reference against itself", fontsize=10)
    times.set_title("Time of the first frames, on a shared CPU", fontsize=10)
    times.set_xlabel("time [s]")
    for one in (axis, times):
        one.set_xscale("log")
        one.grid(True, which="major", linewidth=0.4, alpha=0.6)
        plain_numbers(one)
    axis.set_xticks(sorted({row["cells"] for *_, own in _fronts(result) for row in own}))
    axis.set_xticks([], minor=True)
    times.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))  # beside the lines, none of which it hides
    save_figure(figure, pictures / "refinement.png")
