"""The recorded JSON: how a record is started, written and read."""

from __future__ import annotations

import argparse
import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock

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
    """Add to an earlier record of the same device, and write after each part.

    What another process has added to the record or measured anew meanwhile is kept.
    """
    folder = Path(options.results)
    path = folder / f"{name}.json"
    before: Row = {}
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["device"] == result["device"]:
            result, before = kept | result, kept
    before = copy.deepcopy(before)

    def save(now: Row) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_suffix(".lock")):
            there = json.loads(path.read_text()) if path.exists() else {}
            same = there.get("device") == now["device"]
            write(folder, name, merged(there, changed(before, now)) if same else now, quiet=True)

    measure(options, result, save)
    path.with_suffix(".lock").unlink(missing_ok=True)
    print(f"wrote {path}")


def merged(old: Row, new: Row) -> Row:
    """A record with the rows of both, those of ``new`` where both have one; tables of rows are merged, rows are not."""
    both = dict(old)
    for key, value in new.items():
        both[key] = merged(both[key], value) if _are_tables(value, both.get(key)) else value
    return both


def changed(before: Row, now: Row) -> Row:
    """The rows of a record that are not as they were."""
    found: Row = {}
    for key, value in now.items():
        if key not in before or before[key] != value:
            found[key] = changed(before[key], value) if _are_tables(value, before.get(key)) else value
    return found


def _are_tables(*parts: object) -> bool:
    return all(isinstance(part, dict) and all(isinstance(row, dict) for row in part.values()) for part in parts)
