"""The goals of ``bench.py accuracy``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bench.tables.rows import Row, order, select

GATES: list[tuple[str, str, Callable[[list[Row]], tuple[str, bool] | None]]] = []


def gate(name: str, wanted: str) -> Callable[..., Any]:
    """Register a goal: a function of the rows that gives what was measured and whether it is reached."""

    def register(function: Callable[[list[Row]], tuple[str, bool] | None]) -> Any:
        GATES.append((name, wanted, function))
        return function

    return register


def _bar_gate(ends: str) -> Callable[[list[Row]], tuple[str, bool] | None]:
    def judge(rows: list[Row]) -> tuple[str, bool] | None:
        found = select(rows, "vibrating bar", variant="total", ends=ends, cells=64)
        return (f"{100 * found[0]['result']['error']:.3f} %", found[0]["result"]["error"] <= 0.005) if found else None

    return judge


gate("confined bar (free ends; each half is a fixed-free bar), frequency at 64 cells, `total`", "within 0.5 %")(
    _bar_gate("free")
)


def _points_gate(problem: str, cells: int) -> Callable[[list[Row]], tuple[str, bool] | None]:
    def judge(rows: list[Row]) -> tuple[str, bool] | None:
        found = select(rows, problem, variant="total", cells=cells)
        return (f"{100 * found[0]['result']['error']:.3f} %", found[0]["result"]["error"] <= 0.005) if found else None

    return judge


gate("fixed-free bar, held at points of its wall, frequency at 64 cells, `total`", "within 0.5 %")(
    _points_gate("bar held at points", 64)
)


def _order_gate(problem: str, **parameters: Any) -> Callable[[list[Row]], tuple[str, bool] | None]:
    def judge(rows: list[Row]) -> tuple[str, bool] | None:
        found = sorted(select(rows, problem, variant="total", **parameters), key=lambda r: r["parameters"]["cells"])
        if len(found) < 2:
            return None
        observed = order(found[-2], found[-1])
        return f"{observed:.2f}", observed >= 1.8

    return judge


gate("confined bar, observed order in dx, `total`", "at least 1.8")(_order_gate("vibrating bar", ends="free"))
gate("fixed-free bar, held at points of its wall, observed order in dx, `total`", "at least 1.8")(
    _order_gate("bar held at points")
)
gate("bar hanging from points of its wall, tip at 32 cells, `total`", "within 0.5 %")(
    _points_gate("hanging bar held at points", 32)
)
gate("bar hanging from points of its wall, observed order in dx, `total`", "at least 1.8")(
    _order_gate("hanging bar held at points")
)


@gate("strip on hinges under a side load, sag at 16 cells, `total`", "within 0.5 %")
def _(rows: list[Row]) -> tuple[str, bool] | None:
    found = select(rows, "hinged strip", hold="hinge", cells=16)
    return (f"{100 * found[0]['result']['error']:.3f} %", found[0]["result"]["error"] <= 0.005) if found else None


gate("large-rotation vortex, observed order in dx, `total`", "at least 1.8")(_order_gate("vortex"))


@gate("bar hanging under its own weight, tip at 32 cells, `total`", "within 1 %")
def _(rows: list[Row]) -> tuple[str, bool] | None:
    found = select(rows, "hanging bar", variant="total", cells=32, clamp="mirror")
    return (f"{100 * found[0]['result']['error']:.3f} %", found[0]["result"]["error"] <= 0.01) if found else None


@gate("hinged plate, both laws, `total`", "within 1 degree")
def _(rows: list[Row]) -> tuple[str, bool] | None:
    found = select(rows, "hinged plate", variant="total")
    worst = max((abs(row["result"]["error"]) for row in found), default=None)
    return None if worst is None else (f"{worst:.2f} degrees at worst", worst <= 1)


@gate("drag on a plate and a sphere, for any set of Gaussians, areas `coverage`", "within 3 %")
def _(rows: list[Row]) -> tuple[str, bool] | None:
    found = select(rows, "surface drag", area="coverage")
    worst = max((abs(row["result"]["error"]) for row in found), default=None)
    return None if worst is None else (f"{100 * worst:.2f} % at worst", worst <= 0.03)


@gate("free elastic block, energy averaged over a period, 100 periods, `total`", "change below 0.1 %")
def _(rows: list[Row]) -> tuple[str, bool] | None:
    found = select(rows, "free block", variant="total")
    if not found:
        return None
    change = abs(found[0]["result"]["error"])
    return f"{100 * change:.4f} %", change < 1e-3


@gate("soft flag, E = 3e3 Pa, density 20 to 50, dx 0.08 to 0.01, 250 frames, `total`", "no particle torn or lost")
def _(rows: list[Row]) -> tuple[str, bool] | None:
    found = select(rows, "soft flag")
    if len(found) < 8:
        return None
    torn = sum(row["result"]["torn"] + row["result"]["lost"] for row in found)
    low, high = (f(row["result"][n] for row in found) for f, n in ((min, "stretch_min"), (max, "stretch_max")))
    return f"{torn:.0f} torn or lost, singular values of F in [{low:.2f}, {high:.2f}]", torn == 0 and low > 0
