"""Tables of ``bench.py sweeps``."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import gib, grid, source, yes_no

Row = dict[str, Any]
PAGE = "many.md"

SPEEDUP, SHARE, FASTER, PSNR_DB = 1.9, 0.9, 1.7, 0.1
"""The goals: two GPUs against one, a sweep against one sheet, training on two GPUs, and its loss of PSNR."""


def _section(results: list[Row], name: str) -> Row:
    return next((result[name] for result in results if result.get(name)), {})


def _pair(section: Row, key: str) -> tuple[Any, Any]:
    """A number on one and on two GPUs."""
    rows = section.get("rows", {})
    one, two = (rows.get(count, {}).get(key) for count in "12")
    return one, two  # None where it failed or was not measured


def goals(results: list[Row]) -> list[tuple[str, str, bool | None]]:
    """The goals, the measured values, and whether each goal is reached; None for what was not measured."""
    workers, gpus, training = (_section(results, name) for name in ("workers", "gpus", "training"))
    found: list[tuple[str, str, bool | None]] = []
    goal = "40 small flags on two CPU cores, a worker killed at random five times: complete, and the same table"
    if workers:
        end = workers["disturbed"]
        reached = workers["equal"] and end["complete"] == workers["runs"] and end["killed"] == 5
        told = f"{end['complete']} complete, {end['killed']} killed, tables {'' if workers['equal'] else 'not '}equal"
        found.append((goal, told, reached))
    else:
        found.append((goal, "-", None))
    one, two = _pair(gpus, "wall_s")
    goal = f"256 flags of 4,096 points on 2 GPUs at least {SPEEDUP:g} times as fast as on one"
    if one and two:
        frames = _pair(gpus, "frames_s")
        told = f"{one / two:.2f} times the whole command, {frames[0] / frames[1]:.2f} times from first to last frame"
        found.append((goal, told, one / two >= SPEEDUP))
    else:
        found.append((goal, "-", None))
    rate, whole = _pair(gpus, "per_s")[0], gpus.get("sheet", {}).get("per_s")
    goal = f"the same on one GPU at no less than {100 * SHARE:g} % of the particle rate of one sheet"
    found.append((goal, f"{100 * rate / whole:.0f} %", rate / whole >= SHARE) if rate and whole else (goal, "-", None))
    one, two = _pair(training, "seconds")
    goal = f"the fox at four times its size on 2 GPUs: training at least {FASTER:g} times as fast"
    found.append((goal, f"{one / two:.2f} times", one / two >= FASTER) if one and two else (goal, "-", None))
    one, two = _pair(training, "psnr_db")
    goal = f"the same PSNR within {PSNR_DB:g} dB"
    found.append((goal, f"{two - one:+.2f} dB", abs(two - one) <= PSNR_DB) if one and two else (goal, "-", None))
    return found


@table(PAGE, "sweeps.goals", "sweeps_*", together=True)
def goal_table(results: list[Row]) -> list[str]:
    """The goals."""
    rows = [[goal, measured, yes_no(reached)] for goal, measured, reached in goals(results)]
    return grid(["goal", "measured", "reached"], rows)


@table(PAGE, "sweeps.devices", "sweeps_*", together=True)
def devices(results: list[Row]) -> list[str]:
    """The devices of the records."""
    return [line for result in results for line in (source(result), "")]


@table(PAGE, "sweeps.workers", "sweeps_*", together=True)
def workers_table(results: list[Row]) -> list[str]:
    """A sweep with and without killed workers."""
    section = _section(results, "workers")
    if not section:
        return ["Not recorded yet."]
    head = [
        f"{section['runs']} small flags, {section['workers']} workers",
        "killed",
        "complete",
        "runs begun",
        "seconds",
    ]
    rows = []
    for name in ("undisturbed", "disturbed"):
        row = section[name]
        rows.append([name, *(str(row[key]) for key in ("killed", "complete", "attempts")), f"{row['seconds']:.0f}"])
    return grid(head, rows)


@table(PAGE, "sweeps.gpus", "sweeps_*", together=True)
def gpus_table(results: list[Row]) -> list[str]:
    """Many flags on GPUs, and one sheet."""
    section = _section(results, "gpus")
    if not section:
        return ["Not recorded yet."]
    rows = []
    for count, row in section["rows"].items():
        title = f"{section['flags']} flags, {section['frames']} frames, {count} GPU{'s' * (count != '1')}"
        rows.append([title, "failed", "-", "-", "-", "-"] if "per_s" not in row else _cells(title, row))
    if "per_s" in section.get("sheet", {}):
        row = section["sheet"]
        title = f"one sheet, {row['frames']} frames, 1 GPU"
        rows.append([title, f"{row['particles']:,}", "-", f"{row['frames_s']:.1f}", f"{row['per_s'] / 1e6:,.0f}", "-"])
    head = ["", "points of each", "whole command [s]", "frames [s]", "10⁶ particle substeps/s", "memory of a GPU [GiB]"]
    return grid(head, rows)


def _cells(title: str, row: Row) -> list[str]:
    numbers = f"{row['wall_s']:.1f}", f"{row['frames_s']:.1f}", f"{row['per_s'] / 1e6:,.0f}"
    return [title, f"{row['particles']:,}", *numbers, gib(row["memory_bytes"])]


@table(PAGE, "sweeps.training", "sweeps_*", together=True)
def training_table(results: list[Row]) -> list[str]:
    """Training on GPUs."""
    section = _section(results, "training")
    if not section:
        return ["Not recorded yet."]
    rows = []
    for count, row in section["rows"].items():
        title = f"{section['images']:,} images, {count} GPU{'s' * (count != '1')}"
        known = "seconds" in row
        rows.append(
            [title, str(row["steps"]), f"{row['seconds']:.1f}", f"{row['psnr_db']:.2f}", f"{row['gaussians']:,}"]
            if known
            else [title, "failed", "-", "-", "-"]
        )
    return grid(["the fox, 1080 x 1920 pixels", "steps", "seconds", "PSNR [dB]", "Gaussians"], rows)
