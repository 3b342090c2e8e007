"""Stamps of rows that were measured before rows had stamps, from the history of the repository.

``PYTHONPATH=.:tools python -m bench.history`` gives each row without a stamp the date, the versions and the sources of
the commit in which it first appears. It was measured then or earlier.

``... bench.history dropped RECORD COMMIT`` first adds to a record of flags the rows that it lacks and the commit has.
"""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from typing import Any

from bench import record, stamps

Row = dict[str, Any]
FORMER = {"flags_made_cpu": "flags_cpu"}
"""Records that had another name."""
ROWS = {"particle": "own_volumes"}
"""Rows of flags that had another name."""


def git(*arguments: str) -> str:
    """What a command of git says."""
    return subprocess.run(["git", *arguments], cwd=record.ROOT, capture_output=True, text=True, check=True).stdout


@cache
def sources(commit: str, part: str) -> str:
    """The hash of a part of the package in a commit, as :func:`bench.stamps.sources` makes it."""
    lines = git("ls-tree", "-r", commit, part if "/" in part else f"{stamps.PACKAGE}/{part}").splitlines()
    return stamps.of_blobs([(line.split()[2], line.partition("\t")[2]) for line in lines])


def versions_of(name: str) -> list[tuple[str, str, Row]]:
    """Commit, date and content of each recorded version of a record, the oldest first."""
    paths = [f"docs/results/{each}.json" for each in (FORMER.get(name), name) if each]
    found = []
    for line in git("log", "--reverse", "--format=%H %cI", "--", *paths).splitlines():
        commit, date = line.split()
        for path in paths:
            if git("ls-tree", commit, path):
                found.append((commit, date, json.loads(git("show", f"{commit}:{path}"))))
    return found


def stamp(name: str, result: Row) -> Row:
    """The stamps of a record's rows, those that it has and those from the history."""
    has = stamps.stamp_of(result)
    found = stamps.kept(result, result) if has else {}
    found.pop("unknown", None)
    without = {place: stamps.digest(row) for place, row in stamps.rows(result) if place not in has}
    for commit, date, old in versions_of(name) if without else ():
        known = {stamps.digest(row): row for _, row in stamps.rows(old)}
        if there := {place: said for place, said in without.items() if said in known}:
            row = known[next(iter(there.values()))]
            found[commit[:12]] = {"date": date[:19].replace("T", " "), "commit": commit[:12], "clean": None,
                                  "from_history": True, "versions": old.get("versions") or row.get("versions") or {},
                                  "sources": {part: sources(commit, part) for part in stamps.parts_of(name)},
                                  "rows": there}  # fmt: skip
            without = {place: said for place, said in without.items() if place not in there}
    return found


def dropped(name: str, commit: str) -> None:
    """Add the rows of a commit that a record of flags lacks, and what ``ours`` was then, as ``dropped``."""
    path = record.RESULTS / f"{name}.json"
    result = json.loads(path.read_text())
    old = json.loads(git("show", f"{commit}:docs/results/{FORMER.get(name, name)}.json"))["rows"]
    old = {ROWS.get(row, row): found for row, found in old.items()}
    result["dropped"] = {"ours": old["ours"]}
    for row, found in old.items():
        if left := {pattern: one for pattern, one in found.items() if pattern not in result["rows"].get(row, {})}:
            result["dropped"][row] = left
    path.write_text(json.dumps(result, indent=2) + "\n")


def main() -> None:
    """Give all records their stamps."""
    if sys.argv[1:2] == ["dropped"]:
        dropped(*sys.argv[2:])
    for path in sorted(record.RESULTS.glob("*.json")):
        if path.name != record.AGES:
            result = json.loads(path.read_text())
            result["measured"] = stamp(path.stem, result)
            if len(stamps.stamp_of(result)) < len(dict(stamps.rows(result))):
                raise SystemExit(f"{path.name} has rows that no commit has: commit it first")
            record.write(record.RESULTS, path.stem, result, quiet=True)
            print(path.stem, {key: len(each["rows"]) for key, each in result["measured"].items()})


if __name__ == "__main__":
    main()
