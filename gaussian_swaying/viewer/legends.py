"""Legends of the colours on the live page."""

from __future__ import annotations

import torch

from gaussian_swaying.rendering.colormap import colormap


def legend(name: str, unit: str, largest: float) -> str:
    """A colour scale from zero to a largest value, as HTML.

    Args:
        name: Name of the quantity.
        unit: Its unit.
        largest: End of the scale.
    """
    colours = (255 * colormap(torch.linspace(0, 1, 9, dtype=torch.float64))).round().int().tolist()
    stops = ", ".join(f"rgb({r},{g},{b})" for r, g, b in colours)
    return (
        f'<div style="padding: 0 0.8em 0.6em; font-size: 0.8em">{name} [{unit}]'
        f'<div style="height: 0.9em; border-radius: 2px; background: linear-gradient(to right, {stops})"></div>'
        '<div style="display: flex; justify-content: space-between">'
        f"<span>0</span><span>{0.5 * largest:.3g}</span><span>{largest:.3g} and more</span></div></div>"
    )
