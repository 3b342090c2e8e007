"""Rows of ``bench.py accuracy`` by problem and parameters, and the order of convergence between two."""

from __future__ import annotations

import math
from typing import Any

Row = dict[str, Any]


def all_rows(results: list[Row]) -> list[Row]:
    """The rows of all records."""
    return [row for result in results for row in result["rows"]]


def order(coarse: Row, fine: Row) -> float:
    """Observed order of convergence in dx between two rows of the same problem."""
    ratio = fine["parameters"]["cells"] / coarse["parameters"]["cells"]
    return math.log(coarse["result"]["error"] / fine["result"]["error"]) / math.log(ratio)


def own_order(rows: list[Row], name: str = "ratio") -> float:
    """Observed order of convergence in dx of three rows, in ascending number of cells, toward their own limit.

    For a result whose exact value is not known as well as the finest grid knows it: the order p at which
    (f1 - f2) / (f2 - f3) = (h1^p - h2^p) / (h2^p - h3^p), with h = 1 / cells (Roache, *Verification and Validation in
    Computational Science and Engineering*, 1998, section 5.10). NaN if the differences change their sign, or if no
    order from 0.1 to 10 explains them.
    """
    cells = [row["parameters"]["cells"] for row in rows]
    first, second, third = (row["result"][name] for row in rows)
    if (first - second) * (second - third) <= 0:
        return math.nan
    wanted = (first - second) / (second - third)

    def excess(p: float) -> float:
        coarse, middle, fine = (n**-p for n in cells)
        return (coarse - middle) / (middle - fine) - wanted

    low, high = 0.1, 10.0  # the excess grows with the order
    if excess(low) > 0 or excess(high) < 0:
        return math.nan
    for _ in range(60):
        p = (low + high) / 2
        low, high = (p, high) if excess(p) < 0 else (low, p)
    return low


def select(rows: list[Row], problem: str, **parameters: Any) -> list[Row]:
    """The rows of a problem that have the given parameters and did not fail."""
    return [
        row
        for row in rows
        if row["problem"] == problem
        and "failed" not in row["result"]
        and all(row["parameters"].get(name) == value for name, value in parameters.items())
    ]
