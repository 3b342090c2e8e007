"""How the plots are written."""

from pathlib import Path
from typing import Any


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure of matplotlib, with its folder, and forget it."""
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
