"""Rows of ``bench.py accuracy`` by problem and parameters, and the order of convergence between two."""

from __future__ import annotations

import math
from typing import Any

Row = dict[str, Any]


def order(coarse: Row, fine: Row) -> float:
    """Observed order of convergence in dx between two rows of the same problem."""
    ratio = fine["parameters"]["cells"] / coarse["parameters"]["cells"]
    return math.log(coarse["result"]["error"] / fine["result"]["error"]) / math.log(ratio)


def select(rows: list[Row], problem: str, **parameters: Any) -> list[Row]:
    """The rows of a problem that have the given parameters and did not fail."""
    return [
        row
        for row in rows
        if row["problem"] == problem
        and "failed" not in row["result"]
        and all(row["parameters"].get(name) == value for name, value in parameters.items())
    ]
