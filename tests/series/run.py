"""Try thousands of malformed inputs, faults and extremes, and count how they end.

    python tests/series/run.py                          # all 4,200, in two processes; about an hour
    python tests/series/run.py --series ply yaml --count 100 --seed 5
    python tests/series/run.py --series extreme --only 17   # one case, with what it said

Every case runs in a process of its own. It is good if the command ran, refused with one sentence and exit code 2, or
takes long and shows how long; bad if there was a traceback, an exit code without a sentence, a hang, or more memory
than a gigabyte and ten times its input.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parents[1])]
os.environ.update(OMP_NUM_THREADS="1", GAUSSIAN_SWAYING_DEBUG="0")

import capture_cases  # noqa: E402
import extreme_cases  # noqa: E402
import fault_cases  # noqa: E402
import ply_cases  # noqa: E402
import run_folder_cases  # noqa: E402
import splat_cases  # noqa: E402
import yaml_cases  # noqa: E402
from commands import commands  # noqa: E402
from sandbox import GOOD, TIME, Case, Verdict, try_case  # noqa: E402

SERIES: dict[str, tuple[Callable[[int, int], Iterator[Case]], int]] = {
    "ply": (ply_cases.cases, 1000),
    "splat": (splat_cases.cases, 500),
    "yaml": (yaml_cases.cases, 900),
    "capture": (capture_cases.cases, 700),
    "folder": (run_folder_cases.cases, 400),
    "fault": (fault_cases.cases, 300),
    "extreme": (extreme_cases.cases, 400),
}


def _spoilt(arguments: list[str]) -> int | None:
    """A command in a process whose standard streams are spoilt, as its first two arguments say."""
    name, stream, how, *given = arguments
    if how == "ascii":
        for old in (sys.stdout, sys.stderr):
            old.reconfigure(encoding="ascii", errors="strict")  # type: ignore[union-attr]
    else:
        fault_cases.spoil(stream, how)
    return _COMMANDS[name](given)


_COMMANDS: dict[str, Callable[[list[str]], int | None]] = {}


def _start() -> None:
    """Import the commands, once in each process that tries cases."""
    if not _COMMANDS:
        _COMMANDS.update(commands() | {"spoilt": _spoilt})


def _share(name: str, seed: int, numbers: list[int], limit: float) -> list[Verdict]:
    """Verdicts of some cases of a series, without the functions that made them."""
    _start()
    make, _ = SERIES[name]
    found = []
    for number, case in enumerate(make(seed, max(numbers, default=-1) + 1)):
        if number in numbers:
            verdict = try_case(case, _COMMANDS, limit)
            bare = Case(case.series, case.name, case.command, list)  # a function within a function cannot be sent
            found.append(Verdict(bare, verdict.kind, verdict.said, verdict.seconds, verdict.memory))
    return found


def try_series(name: str, count: int, seed: int = 0, workers: int = 1, limit: float = TIME) -> list[Verdict]:
    """Try the first cases of a series.

    Args:
        name: Of ``SERIES``.
        count: Number of cases.
        seed: From which they are made.
        workers: Processes that try them.
        limit: Time of the processor after which a case hangs [s].
    """
    parts = [list(range(first, min(first + 10, count))) for first in range(0, count, 10)]
    if workers == 1:
        return [verdict for part in parts for verdict in _share(name, seed, part, limit)]
    with get_context("spawn").Pool(workers, initializer=_start) as pool:
        shares = pool.starmap(_share, [(name, seed, part, limit) for part in parts], chunksize=1)
    return [verdict for share in shares for verdict in share]


def table(found: list[Verdict]) -> str:
    """Counts by series, as Markdown."""
    bad = sorted({verdict.kind for verdict in found if not verdict.good})
    kinds = [*GOOD, *bad]
    rows = [["series", "cases", *kinds, "slowest [s]", "most memory [MB]"], ["---"] * (4 + len(kinds))]
    names = list(dict.fromkeys(verdict.case.series for verdict in found))
    for name in [*names, *(["all"] if len(names) > 1 else [])]:
        own = [verdict for verdict in found if name in (verdict.case.series, "all")]
        counts = Counter(verdict.kind for verdict in own)
        slowest, most = max(v.seconds for v in own), max(v.memory for v in own)
        rows.append([name, len(own), *(counts[kind] for kind in kinds), f"{slowest:.1f}", round(most / 1e6)])
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def main() -> int:
    """Try, print what went wrong and the counts; 1 if something did."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--series", nargs="+", choices=tuple(SERIES), default=tuple(SERIES))
    parser.add_argument("--count", type=int, help="cases of each series; by default 4,200 in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit", type=float, default=TIME, help="time of the processor after which a case hangs [s]")
    parser.add_argument("--only", type=int, help="number of one case")
    options = parser.parse_args()
    found: list[Verdict] = []
    for name in options.series:
        if options.only is not None:
            found += _share(name, options.seed, [options.only], options.limit)
            print(f"{found[-1].case.name}: {found[-1].kind}\n{found[-1].said}")
            continue
        new = try_series(name, options.count or SERIES[name][1], options.seed, options.workers, options.limit)
        for verdict in (verdict for verdict in new if not verdict.good):
            last = (verdict.said.splitlines() or [""])[-1]
            print(f"{verdict.kind}: {verdict.case.series} {verdict.case.name} ({verdict.memory / 1e6:.0f} MB): {last}")
        found += new
        print(table(new), flush=True)
    print(table(found))
    return 0 if all(verdict.good for verdict in found) else 1


if __name__ == "__main__":
    sys.exit(main())
