"""``bench.py stability``: where runs of small bodies are right, warned of, refused, or wrong without a word."""

from __future__ import annotations

import argparse
import hashlib
import re
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from bench import stamps
from bench.case import Case, Measurement, names, option
from bench.problems.stability import AXES, BODIES, apart, configuration, energy_error, faults
from bench.record import Row
from gaussian_swaying._inputs import read_json
from gaussian_swaying.cli.sweep import explain
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.plan import make_plan, read_sweep
from gaussian_swaying.sweeps.record import SWEEP
from gaussian_swaying.sweeps.sweep import run_sweep

RIGHT, WARNED, TOLD, REFUSED, WRONG = "right", "warned", "wrong and warned", "refused", "wrong"
LETTERS = {RIGHT: "r", WARNED: "w", TOLD: "t", REFUSED: "x", WRONG: "!"}
DETAIL = re.compile("What to change|The largest displacement")
"""Sentences that only add to another one."""
Frames = dict[str, list[Row]]
"""Diagnostics of the frames of each run that has ended, by its number."""


def verdict(status: str, reason: str | None, warned: bool, found: list[str]) -> str:
    """One word for a run: a failure that is a bug of the package is wrong, one that says what to change a refusal."""
    if status != "complete":
        return WRONG if "This is a bug" in str(reason) else REFUSED
    if found:
        return TOLD if warned else WRONG
    return WARNED if warned else RIGHT


def sentence(text: str) -> str:
    """The first words of a message, without its numbers."""
    text = re.sub(r"^.*Warning: ", "", text.strip().splitlines()[0])
    text = re.sub(r"-?\d[\d.,]*(e[-+]?\d+)?", "N", text)
    return " ".join(re.split(r"[:;(]| so | of its length| at \[", text)[0].split()[:14])


def swept(body: str, dx: float, axes: dict[str, list[Any]], folder: Path) -> tuple[list[Row], Frames]:
    """Sweep a body on a grid; what the package says of each run, and the frames of those that ended.

    Runs that a sweep in the folder has completed are not done again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    base, file = folder / "base.yaml", folder / "sweep.yaml"
    base.write_text(yaml.safe_dump(configuration(BODIES[body], dx)))
    file.write_text(yaml.safe_dump({"base": str(base), "axes": axes}, sort_keys=False))
    plan = make_plan(read_sweep(file), Simulation.parser())
    resume = (folder / "runs" / SWEEP).exists()
    results = run_sweep(plan, folder / "runs", resume=resume, workers=1, threads=1, retries=0, explain=explain,
                        device="cpu", progress=False)  # fmt: skip
    told, frames = [], {}
    for name in plan.names:
        log = folder / "runs" / "logs" / f"{name}.txt"
        said = [line for line in log.read_text().splitlines() if "Warning: " in line] if log.exists() else []
        summary = folder / "runs" / "runs" / name / "summary.json"
        if results[name]["status"] == "complete":
            found = read_json(summary, "summary")
            frames[name], said = found["per_frame"], said + [one for one in found["warnings"] if not DETAIL.match(one)]
        told.append(results[name] | {"name": name, "said": said})
    return told, frames


def judged(told: list[Row], frames: Frames, reference: Frames | None) -> Row:
    """The row of a body on a grid: a letter for each run, in the order of the sweep, and what was said and found."""
    letters, said, found = "", Counter[str](), Counter[str]()
    worst = {"energy": 0.0, "grid": 0.0}
    for one in told:
        own, other = frames.get(one["name"]), None if reference is None else reference.get(one["name"])
        wrong = [] if own is None else faults(own, other)
        word = verdict(one["status"], one["reason"], bool(one["said"]), wrong)
        letters += LETTERS[word]
        said.update({sentence(text) for text in (one["said"] or ([one["reason"]] if one["reason"] else []))})
        found.update(f"{name}, {word}" for name in wrong)
        if word == RIGHT and own is not None:
            worst["energy"] = max(worst["energy"], energy_error(own))
            worst["grid"] = max(worst["grid"], apart(own, other) if other is not None else 0.0)
    counts = {word: letters.count(letter) for word, letter in LETTERS.items()}
    return {"runs": len(letters), "counts": counts, "letters": letters, "said": dict(said.most_common()),
            "faults": dict(found.most_common()), "worst_right": worst}  # fmt: skip


def code() -> str:
    """A hash of the parts of the package that the map depends on."""
    parts = [stamps.sources(part) for part in stamps.parts_of("stability") if "/" not in part]
    return hashlib.sha256("".join(parts).encode()).hexdigest()[:8]


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Each body from the finest grid to the coarsest, as the finest is the reference.

    The sweeps stay in a folder, so that a map that was stopped goes on; changed code has a folder of its own.
    """
    if result.get("axes") != AXES:
        result |= {"axes": AXES, "rows": []}
    kept = Path(options.runs) / code()
    for body in options.bodies:
        reference: Frames = {}

        def measure(body: str = body, dx: float = 0.0, first: bool = False, reference: Frames = reference) -> Row:
            told, frames = swept(body, dx, AXES, kept / f"{body}_{dx:g}")
            row = judged(told, frames, None if first else reference)
            if first:
                reference.update(frames)
            return row | {"reference": first}

        for dx in reversed(BODIES[body].sizes):
            yield ("rows", {"body": body, "dx": dx}), partial(measure, dx=dx, first=dx == BODIES[body].sizes[-1])


CASE = Case(
    "Sweep three small bodies over grid, material and wind, and find which runs are wrong without a word.",
    rows,
    (names("--bodies", BODIES), option("--runs", "folder that keeps the runs", default="outputs/stability")),
    page="stability.md",
    device=False,
)
