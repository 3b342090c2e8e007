"""When, and from which code, each row of a record was measured.

A record has a table ``measured``: under a name, a date, a commit, whether the tree was clean, the versions, a hash of
each part of the package that the record measures, and the rows measured then: their places, with a hash of what they
say.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from collections.abc import Iterator
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any

from gaussian_swaying._provenance import versions

Row = dict[str, Any]
ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "gaussian_swaying"

_SOLVER = ("mpm", "geometry", "aero")
_PROBLEMS = (*_SOLVER, "tools/bench/problems")
_SIMULATION = (*_SOLVER, "gaussians", "recording", "simulation")
_DRAWN = (*_SIMULATION, "rendering")
PARTS: dict[str, tuple[str, ...]] = {
    "accuracy": _PROBLEMS,
    "air": ("air", *_PROBLEMS),
    "area": ("gaussians", "geometry"),
    "backward": _SOLVER,
    "blender": _SIMULATION,
    "contact": _SIMULATION,
    "detail": ("rendering", "geometry"),
    "drawn": (*_DRAWN, "viewer"),
    "film_fit": (*_DRAWN, "fitting", "preview"),
    "fit": (*_DRAWN, "fitting"),
    "flags": (*_DRAWN, "evaluation", "training"),
    "folds": (*_SIMULATION, "evaluation"),
    "frames": _SIMULATION,
    "gallery": _DRAWN,
    "gradients": _SIMULATION,
    "hand_films": (*_DRAWN, "fitting"),
    "handheld": (*_DRAWN, "fitting"),
    "leaves": _DRAWN,
    "live": (*_DRAWN, "viewer"),
    "long_flag": _SIMULATION,
    "nature": _PROBLEMS,
    "pareto": _PROBLEMS,
    "peers": (),  # other solvers
    "pins": (*_SIMULATION, "evaluation"),
    "points": _SIMULATION,
    "previews": (*_SIMULATION, "preview"),
    "places": (*_SIMULATION, "preview"),
    "refinement": _SIMULATION,
    "registration": ("gaussians", "geometry", "rendering", "fitting"),
    "sim": _DRAWN,
    "soft": (*_DRAWN, "fitting"),
    "speed": _DRAWN,
    "stability": (*_SIMULATION, "sweeps", "tools/bench/problems"),
    "substep": _SOLVER,
    "surfaces": (*_DRAWN, "training"),
    "sweeps": (*_DRAWN, "sweeps", "training"),
    "train": ("gaussians", "geometry", "rendering", "training"),
    "web": (*_DRAWN, "viewer"),
    "winds": _SOLVER,
}
"""What a record measures, by the beginning of its name: parts of the package, or folders."""

_NOT_ROWS = ("device", "versions", "seed", "measured", "uncertainty", "references", "figures")
_UNKNOWN = {"date": None, "commit": None, "clean": None, "versions": {}, "sources": {}}


def rows(result: Row) -> Iterator[tuple[str, Row]]:
    """The place of each row of a record, such as ``rows/ours/1``, and the row."""
    for key, part in result.items():
        if key not in _NOT_ROWS:
            yield from _within(key, part)


def _within(place: str, part: Any) -> Iterator[tuple[str, Row]]:
    if isinstance(part, list):
        yield from ((f"{place}/{index}", row) for index, row in enumerate(part) if isinstance(row, dict))
    elif isinstance(part, dict) and part:
        if all(isinstance(row, dict) for row in part.values()):
            for name, row in part.items():
                yield from _within(f"{place}/{name}", row)
        else:
            yield place, part


def parts_of(name: str) -> tuple[str, ...]:
    """The parts of the package that a record measures."""
    return next((parts for start, parts in PARTS.items() if name.startswith(start)), ())


@cache
def sources(part: str) -> str:
    """A hash of the Python files of a part of the package or of a folder: their paths, and git's names of them."""
    lines = []
    for path in (ROOT / part if "/" in part else ROOT / PACKAGE / part).rglob("*.py"):
        data = path.read_bytes().replace(b"\r\n", b"\n")
        name = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        lines.append(f"{path.relative_to(ROOT).as_posix()} {name}")
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:16]


def _git(*arguments: str) -> str | None:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else None


@cache
def now() -> Row:
    """Date, commit, whether the tree was clean, and versions of this process.

    Where there is no history (on a borrowed machine), the variable BENCH_COMMIT says what ``git describe --always
    --dirty --exclude='*'`` says where there is one.
    """
    commit = os.environ.get("BENCH_COMMIT") or _git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    date = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S")
    clean = None if not commit else not commit.endswith("-dirty")
    return {"date": date, "commit": commit and commit.removesuffix("-dirty"), "clean": clean, "versions": versions()}


def digest(row: Row) -> str:
    """A short hash of what a row says."""
    return hashlib.sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()[:8]


def stamp_of(result: Row) -> dict[str, str]:
    """The name of the stamp of each row, by place; a row that was changed after it was stamped has none."""
    known = {place: (name, said) for name, stamp in result.get("measured", {}).items()
             for place, said in stamp["rows"].items()}  # fmt: skip
    return {place: known[place][0] for place, row in rows(result) if known.get(place, ("", ""))[1] == digest(row)}


def kept(old: Row, result: Row) -> Row:
    """The stamps of the rows of ``result`` that are rows of an earlier record."""
    names, measured = stamp_of(old), old.get("measured", {})
    known = {(_table(place), digest(row)): names.get(place, "unknown") for place, row in rows(old)}
    found: Row = {}
    for place, row in rows(result):
        if name := known.get((_table(place), said := digest(row))):
            found.setdefault(name, {**measured.get(name, _UNKNOWN), "rows": {}})["rows"][place] = said
    return found


def _table(place: str) -> str:
    """The place of a row without its number in a list."""
    first, _, last = place.rpartition("/")
    return first if last.isdigit() else place


def stamped(name: str, result: Row) -> Row:
    """A record with a stamp of now on every row that has none."""
    names, measured, fresh = stamp_of(result), {}, {}
    for place, row in rows(result):
        if key := names.get(place):
            stamp = result["measured"][key]
            measured.setdefault(key, {**stamp, "rows": {}})["rows"][place] = digest(row)
        else:
            fresh[place] = digest(row)
    if fresh:
        stamp = now() | {"sources": {part: sources(part) for part in parts_of(name)}}
        before = measured.get(stamp["date"], {"rows": {}})["rows"]
        measured[stamp["date"]] = {**stamp, "rows": before | fresh}
    without = {key: part for key, part in result.items() if key != "measured"}
    return without | ({"measured": measured} if measured else {})


def ages(records: dict[str, Row]) -> Row:
    """For each record and stamp, the parts of the package that are not as they were; stamps of today's are left out."""
    found: Row = {}
    for name, result in records.items():
        for key, stamp in result.get("measured", {}).items():
            if changed := [part for part in parts_of(name) if stamp["sources"].get(part) != sources(part)]:
                found.setdefault(name, {})[key] = changed
    return found
