"""The log of a training run: rows are appended to ``metrics.csv`` and never removed."""

from __future__ import annotations

import csv
from argparse import Namespace
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from gaussian_swaying._files import write_table


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Append a row to a CSV file with a header; a new column is added to all earlier rows.

    Args:
        path: The file; it is created, with its folder, if it does not exist.
        row: Values by column.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    names: list[str] = []
    whole = True
    if path.exists():
        with path.open("rb") as file:
            first = file.readline()
            file.seek(max(file.seek(0, 2) - 1, 0))
            whole = file.read() in (b"\n", b"")
        names = next(csv.reader([first.decode(errors="replace")]), [])
    if not set(row) <= set(names):
        rows: list[dict[str, Any]] = []
        if names:
            with path.open(newline="", encoding="utf-8", errors="replace") as text:
                rows = [{name: line.get(name) for name in names} for line in csv.DictReader(text)]
        wider = [*names, *sorted(set(row) - set(names))]
        write_table(path, [{name: line.get(name) for name in wider} for line in [*rows, row]])
        return
    with path.open("a", newline="", encoding="utf-8") as text:
        if not whole:  # the last row was cut off when the run was killed
            text.write("\r\n")
        csv.DictWriter(text, fieldnames=names).writerow(row)


class CsvLog(Logger):
    """Lightning's values as rows of ``metrics.csv``, each with its ``step``. No file is written before the first row.

    Lightning's ``CSVLogger`` deletes a log that is in its folder, so a resumed run would lose its rows.

    Args:
        folder: Folder of the file.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    @property
    def name(self) -> str:
        return ""

    @property
    def version(self) -> str:
        """Empty, for the same reason."""
        return ""

    @property
    def save_dir(self) -> str:
        return str(self.folder)

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        append_row(
            self.folder / "metrics.csv", {name: float(value) for name, value in metrics.items()} | {"step": step}
        )

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Do nothing: the configuration is in ``config.yaml``."""
