"""The recorded JSON: how a record is started, written and read."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying._files import write_text
from gaussian_swaying._provenance import describe_device, versions

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
Row = dict[str, Any]


def start(device: str) -> tuple[torch.device, Row]:
    """The device for a name or ``auto``, and the head of a record: device, versions and seed."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    found = torch.device(device)
    return found, {"device": describe_device(found), "versions": versions(), "seed": 0}


def write(folder: Path, name: str, result: Row, quiet: bool = False) -> None:
    """Write a record into the folder of the results, without paths of this machine."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    write_text(path, json.dumps(result, indent=2).replace(str(ROOT) + "/", "") + "\n")
    if not quiet:
        print(f"wrote {path}")


def read(folder: Path) -> dict[str, Row]:
    """All records of a folder, by the name of their file without its ending."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def kept_rows(folder: Path, name: str, keep: Callable[[Row], bool]) -> list[Row]:
    """The rows of an earlier record to keep; none if there is no such record."""
    path = folder / f"{name}.json"
    return [row for row in json.loads(path.read_text())["rows"] if keep(row)] if path.exists() else []


def go_on(options: argparse.Namespace, name: str, result: Row, measure: Callable[..., None]) -> None:
    """Add to an earlier record of the same device, and write after each part."""
    folder = Path(options.results)
    path = folder / f"{name}.json"
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["device"] == result["device"]:
            result = kept | result
    measure(options, result, lambda now: write(folder, name, now, quiet=True))
    print(f"wrote {path}")
