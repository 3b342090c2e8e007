"""Table and findings of ``bench.py gradients``."""

from __future__ import annotations

from typing import Any

from bench.slots import table, value
from bench.tables.markdown import grid, source

Row = dict[str, Any]


@table("validation.md", "gradients.memory", "gradients_*")
def memory(result: Row) -> list[str]:
    """Memory and time of a gradient through a rollout."""
    rows = [
        [
            f"`{row['formulation']}`",
            str(row["substeps"]),
            str(row["checkpoint"] or "none"),
            f"{row['memory_MiB']:.0f}",
            f"{row['seconds']:.1f}",
            f"{row['gradient_E']:.6g}",
        ]
        for row in result["memory"]
    ]
    head = ["formulation", "substeps", "`checkpoint`", "memory [MiB]", "seconds", "dL/dE"]
    return [source(result), "", *grid(head, rows)]


@table("validation.md", "gradients.fit", "gradients_*")
def fit(result: Row) -> list[str]:
    """What tools/fit_flag.py found."""
    found = result["fit"]
    columns = zip(found["values"], found["truth"], found["guess"], found["relative_errors"], strict=True)
    rows = [
        [name, f"{value:.6g}", f"{truth:g}", f"{guess:g}", f"{100 * error:.4f} %"]
        for name, (value, truth, guess, error) in zip(("wind [m/s]", "E [Pa]"), columns, strict=True)
    ]
    return grid(["", "found", "true", "first guess", "error"], rows)


@value("gradients.noise", "gradients_*")
def noise(result: Row) -> str:
    """Noise of the fitted trajectory."""
    return f"{1e3 * result['fit']['noise']:g} mm"


@value("gradients.fit_seconds", "gradients_*")
def fit_seconds(result: Row) -> str:
    """How long the fit took."""
    return f"{result['fit']['seconds']:.0f} s"
