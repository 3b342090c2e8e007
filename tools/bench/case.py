"""The schema of a case: a command of ``bench.py`` that measures the rows of a record.

A case makes measurements, one after another. Each has the place of its row in the record: names of tables, then a name
or, in a list, what the row is known by. ``("rows", "ours", "1")`` is ``record["rows"]["ours"]["1"]``, and
``("rows", {"points": 900})`` the row of the list ``record["rows"]`` that is known by ``"points": 900``. A row that is
measured again takes the place of the earlier one, and all others stay. The record is written after each.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bench import record
from bench.record import ROOT, Row

Place = tuple[Any, ...]
Measurement = tuple[Place, Callable[[], Row]]
Option = tuple[str, dict[str, Any]]


def option(name: str, help: str, **settings: Any) -> Option:
    """An option of a case; ``settings`` are those of ``add_argument``."""
    return name, {"help": help} | settings


def chosen(name: str, known: Collection[str], given: str) -> list[str]:
    """The names in a list separated by commas; exits if one is unknown."""
    names = [one for one in given.split(",") if one]
    if unknown := set(names) - set(known):
        raise SystemExit(f"{name} takes {', '.join(known)}, not {', '.join(sorted(unknown))}")
    return names


def names(name: str, known: Collection[str], help: str = "", default: Iterable[str] | None = None) -> Option:
    """An option that takes some of the known names, by default all of them, separated by commas."""
    text = ",".join(known if default is None else default)
    told = (
        f"{help or 'some of ' + ', '.join(known)}, separated by commas (default: {'all' if default is None else text})"
    )
    return option(name, told, type=partial(chosen, name, known), default=text)


def numbers(name: str, help: str, kind: Callable[[str], Any] = int, default: str | None = None) -> Option:
    """An option that takes numbers separated by commas."""
    told = f"{help}, separated by commas" + f" (default: {default})" * bool(default)
    return option(name, told, type=lambda text: [kind(one) for one in text.split(",") if one], default=default)


DATASET = option("--dataset", "folder that tools/datasets/make_flag_dataset.py wrote", required=True)
FRAMES = option("--frames", "only the first frames", type=int)
MORE = option("--more", 'other options of tools/sim.py: --more="--frames=25"', default="")
NOTE = option("--note", "a sentence for the page about how the rows were measured")
PICTURES = option("--pictures", "folder of the pictures", default=str(ROOT / "docs" / "pictures"))
POINTS = option("--points", "points on the reference's surface", type=int, default=10_000)
UNTIL = option("--until", "fit the frames up to this time [s]; half of the video if left out", type=float)


def put(result: Row, place: Place, row: Row) -> None:
    """Put a row at its place in a record."""
    *tables, last = place
    for name in tables[:-1]:
        result = result.setdefault(name, {})
    if isinstance(last, dict):
        others = [one for one in result.get(tables[-1], []) if any(one.get(key) != last[key] for key in last)]
        result[tables[-1]] = [*others, last | row]
    elif tables:
        result.setdefault(tables[-1], {})[last] = row
    else:
        result[last] = row


def at_once(count: int, measurements: Iterable[Measurement]) -> Iterator[Measurement]:
    """Measurements that are made in several threads, in the order in which they end."""
    with ThreadPoolExecutor(count) as pool:
        waiting = {pool.submit(work): place for place, work in measurements}
        for done in as_completed(waiting):
            yield waiting[done], done.result


def apart(count: int, measurements: Iterable[Measurement]) -> Iterator[Measurement]:
    """Measurements that are made in processes of one thread each, in the order in which they end."""
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _alone) as pool:
        waiting = {pool.submit(work): place for place, work in measurements}
        for done in as_completed(waiting):
            yield waiting[done], done.result


def _alone() -> None:
    """Keep a process to one thread."""
    torch.set_num_threads(1)
    with suppress(ImportError):
        import cv2

        cv2.setNumThreads(1)


def _told(place: Place, row: Row) -> str:
    """A line for a row, without its long lists."""
    known = {key: value for part in place if isinstance(part, dict) for key, value in part.items()}
    short = {k: v for k, v in (known | row).items() if not isinstance(v, list) or len(v) < 9}
    return f"{', '.join(part for part in place if isinstance(part, str))}: {json.dumps(short)}"


@dataclass(frozen=True)
class Case:
    """One command that measures.

    Attributes:
        help: What it measures.
        rows: Makes its measurements, from the options and the record so far, to which it may add what is no row.
        options: Its own options.
        page: The page to fill afterwards.
        device: Whether it has the option ``--device``; otherwise it measures on the CPU.
        name: The beginning of the record's name, made from the options; None for the name of the command.
        keeps: Which earlier record it adds to: that of the same ``device``, of ``any``, or of ``none``.
    """

    help: str
    rows: Callable[[argparse.Namespace, Row], Iterator[Measurement]]
    options: tuple[Option, ...] = ()
    page: str | None = None
    device: bool = True
    name: Callable[[argparse.Namespace], str] | None = None
    keeps: str = "device"

    def run(self, command: str, options: argparse.Namespace) -> None:
        """Measure what is asked for, and write the record."""
        device, result = record.start(options.device if self.device else "cpu")
        options.device = device.type
        name = f"{self.name(options) if self.name else command}_{device.type}"
        record.go_on(Path(options.results), name, result, partial(self.measure, options), self.keeps)

    def measure(self, options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
        """Put all rows into a record, and save it after each, and once more at the end."""
        first = True
        for place, work in self.rows(options, result):
            row = work()
            if first:  # what is measured anew is gone: the new row has a stamp of its own, even if it is the same
                save(result)
                first = False
            put(result, place, row)
            print(_told(place, row), flush=True)
            save(result)
        if not first:
            save(result)
