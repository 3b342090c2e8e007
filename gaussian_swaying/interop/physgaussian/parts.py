"""Classes and regions as dicts for a configuration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def part(name: str, **arguments: Any) -> dict[str, Any]:
    """The dict for a class and its arguments."""
    return {"class_path": name, "init_args": arguments}


def box(low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    """A box between two corners."""
    return part("Box", min=[round(v, 12) for v in low], max=[round(v, 12) for v in high])


def box_about(point: Sequence[float], size: Sequence[float]) -> dict[str, Any]:
    """A box around a point, given half of its sides."""
    pairs = list(zip(point, size, strict=True))
    return box([p - s for p, s in pairs], [p + s for p, s in pairs])


__all__ = ["box", "box_about", "part"]
