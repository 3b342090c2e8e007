"""The recorded JSON: how a record is started, written and read. Each row gets the stamp of when it was measured."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock

from bench import stamps
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
    result = json.loads(json.dumps(result).replace(str(ROOT) + "/", ""))
    write_text(path, json.dumps(stamps.stamped(name, result), indent=2) + "\n")
    if not quiet:
        print(f"wrote {path}")


AGES = "ages.json"
"""File beside the records: which stamps are older than the code, as ``bench.py pages`` found."""


def read(folder: Path) -> dict[str, Row]:
    """All records of a folder, by the name of their file without its ending.

    Each of their stamps has the name of the ``record``, and under ``older`` the parts of the package that have changed
    since, as far as the file of ages says.
    """
    found = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json")) if path.name != AGES}
    ages = json.loads((folder / AGES).read_text()) if (folder / AGES).exists() else {}
    for name, result in found.items():
        for key, stamp in result.get("measured", {}).items():
            stamp |= {"record": name, "older": ages.get(name, {}).get(key, [])}
    return found


def go_on(folder: Path, name: str, result: Row, measure: Callable[..., None], keeps: str = "device") -> None:
    """Add to an earlier record, and write after each part.

    What another process has added to the record or measured anew meanwhile is kept.

    Args:
        folder: Folder of the records.
        name: Name of the record.
        result: Its head.
        measure: Function of the record so far, which it adds to, and of a function that writes what it is given.
        keeps: Whose earlier record is added to: that of the same ``device``, of ``any``, or of ``none``.
    """
    path = folder / f"{name}.json"

    def there() -> Row:
        found = json.loads(path.read_text()) if path.exists() else {}
        same = found.get("device") == result["device"] or keeps == "any"
        return found if same else {}

    before = {} if keeps == "none" else there()
    result, before, fresh = before | result, copy.deepcopy(before), keeps == "none"

    def save(now: Row) -> None:
        nonlocal before, fresh
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_suffix(".lock")):
            old = {} if fresh else there()
            new = merged(old, changed(before, now), before)
            new["measured"] = stamps.kept(old, new)
            write(folder, name, new, quiet=True)
            before, fresh = copy.deepcopy(now), False

    measure(result, save)
    path.with_suffix(".lock").unlink(missing_ok=True)
    print(f"wrote {path}")


def merged(old: Row, new: Row, before: Row | None = None) -> Row:
    """A record with the rows of both, those of ``new`` where both have one; tables of rows are merged, rows are not.

    Args:
        old: The record as it is now, with what other processes have done to it.
        new: What this process has changed.
        before: The record that it started from. A list of rows loses those that this process took away since, and
            those that another one did.
    """
    both, before = dict(old), before or {}
    for key, value in new.items():
        was, there = before.get(key), both.get(key)
        if _are_tables(value, there):
            both[key] = merged(there, value, was if _are_tables(was) else None)  # type: ignore[arg-type]
        elif isinstance(value, list) and isinstance(there, list) and isinstance(was, list):
            own = [row for row in value if row not in was or row in there]
            both[key] = own + [row for row in there if row not in was and row not in own]
        else:
            both[key] = value
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
