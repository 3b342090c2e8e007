"""Tables and findings of ``bench.py train``."""

from __future__ import annotations

import statistics
from typing import Any

from bench.cases.training import FLAG_ROWS, FOX_VARIANTS
from bench.slots import table, value
from bench.tables.markdown import gib, grid, source, yes_no

Row = dict[str, Any]
PAGE = "training.md"


def _median(rows: list[Row], key: str) -> float:
    return statistics.median(row[key] for row in rows)


def _alike(result: Row) -> Row:
    """The variants that ran alone, as the pairs did; others come from another session and slower code."""
    variants = result.get("variants", {})
    return {n: row for n, row in variants.items() if "failed" not in row and row.get("runs_per_device", 1) == 1}


def goals(result: Row) -> list[tuple[str, str, bool]]:
    """The goals, the measured values, and whether each goal is reached."""
    found: list[tuple[str, str, bool]] = []
    pair = result.get("pair", {})
    if pair.get("bare") and pair.get("lightning"):
        bare, ours = (_median(pair[name], "psnr_db") for name in ("bare", "lightning"))
        ratio = _median(pair["lightning"], "seconds") / _median(pair["bare"], "seconds")
        memory = max(row["memory_bytes"] for row in pair["lightning"]) / 2**30
        found += [
            ("capture: test PSNR at most 0.1 dB below the bare loop", f"{ours - bare:+.2f} dB", ours >= bare - 0.1),
            ("capture: at most 1.05 times as long as the bare loop", f"{ratio:.2f} times", ratio <= 1.05),
            ("capture: faster than the bare loop", f"{ratio:.2f} times", ratio < 1),
            ("capture: GPU memory within 1 GiB", f"{memory:.2f} GiB", memory <= 1.0),
        ]
        if variants := {name: row["psnr_db"] for name, row in _alike(result).items()}:
            name = max(variants, key=lambda n: variants[n])
            better = f"{variants[name] - bare:+.2f} dB ({FOX_VARIANTS[name][0]})"
            each = [row["psnr_db"] for row in pair["bare"]]
            goal = "capture: a variant measured in the same way is above the bare loop by more than its runs differ"
            found.append((goal, better, variants[name] - bare > max(each) - min(each)))
    row = result.get("flag", {}).get("flag:settled", result.get("flag", {}).get("flag:size"))
    if row and "failed" not in row:
        found += [
            (
                f"flag, all losses: {row['steps']:,} images within 300 s",
                f"{row['seconds']:.0f} s ({row.get('runs_per_device', 1)} at a time)",
                row["seconds"] <= 300,
            ),
            ("flag, all losses: PSNR of at least 35 dB", f"{row['psnr_db']:.1f} dB", row["psnr_db"] >= 35),
            (
                "flag, all losses: median angle between patch and true normal within 5°",
                f"{row['angle_median_deg']:.1f}°",
                row["angle_median_deg"] <= 5,
            ),
        ]
    return found


@table(PAGE, "training.goals", "train_cuda")
def goal_table(result: Row) -> list[str]:
    """The device, and the goals."""
    rows = [[goal, measured, yes_no(reached)] for goal, measured, reached in goals(result)]
    return [source(result), "", *grid(["goal", "measured", "reached"], rows)]


@table(PAGE, "training.capture", "train_cuda")
def capture(result: Row) -> list[str]:
    """The bare loop, Lightning, and the variants."""
    rows = [
        (f"{name}, run {k + 1}", row) for name, rows in result.get("pair", {}).items() for k, row in enumerate(rows)
    ]
    rows += [(FOX_VARIANTS[name][0], row) for name, row in result.get("variants", {}).items()]
    shown = []
    for name, row in rows:
        if "failed" in row:
            shown.append([name, "failed", *[""] * 5])
            continue
        quality = [f"{row['psnr_db']:.2f}", f"{row['ssim']:.3f}", f"{row['gaussians']:,}", f"{row['seconds']:.1f}"]
        shown.append([name, *quality, gib(row["memory_bytes"]), str(row.get("runs_per_device", 1))])
    return grid(["run", "PSNR [dB]", "SSIM", "Gaussians", "seconds", "GPU memory [GiB]", "runs per GPU"], shown)


@value("training.spread", "train_*")
def spread(result: Row, name: str) -> str:
    """Range of the PSNR of the runs with one name."""
    values = [row["psnr_db"] for row in result["pair"][name]]
    return f"{max(values) - min(values):.2f} dB"


@table(PAGE, "training.gains", "train_cuda")
def gains(result: Row) -> list[str]:
    """The variants measured as the bare loop was, sorted by their gain over the mean of its runs."""
    bare = [row["psnr_db"] for row in result.get("pair", {}).get("bare", [])]
    found = {
        FOX_VARIANTS[name][0]: row["psnr_db"] - statistics.mean(bare) for name, row in _alike(result).items() if bare
    }
    return [f"- {found[name]:+.2f} dB {name}" for name in sorted(found, key=lambda name: -found[name])]


@table(PAGE, "training.flag", "train_cuda")
def flag(result: Row) -> list[str]:
    """The effect of each surface loss on a flag whose surface is known."""
    found = {name.removeprefix("flag:"): row for name, row in result.get("flag", {}).items() if "failed" not in row}
    head = ["losses", "round", "decided", "small", "angle to true normal: median, 90 % [°]"]
    head += ["distance: median, 90 % [mm]", "area `paper`", "area `coverage`", "PSNR [dB]", "Gaussians", "seconds"]
    rows = [
        [
            title,
            *(f"{100 * row[share]:.1f} %" for share in ("round_share", "decided_share", "small_share")),
            f"{row['angle_median_deg']:.1f}, {row['angle_p90_deg']:.1f}",
            f"{1e3 * row['distance_median_m']:.2f}, {1e3 * row['distance_p90_m']:.2f}",
            *(f"{row[name]:.2f}" for name in ("area_paper_ratio", "area_coverage_ratio", "psnr_db")),
            f"{row['gaussians']:,}",
            f"{row['seconds']:.0f}",
        ]
        for name, (title, _) in FLAG_ROWS.items()
        if (row := found.get(name)) is not None
    ]
    return grid(head, rows)


@table("from_photos.md", "training.photos", "train_cpu")
def photos(result: Row) -> list[str]:
    """What the recipe for a CPU reaches on a capture."""
    head = ["photos", "size", "images", "Gaussians", "PSNR [dB]", "SSIM", "processor time [min]", "threads"]
    rows = [
        [
            str(row["photos"]),
            f"{row['width']} x {row['height']}",
            f"{row['steps']:,}",
            f"{row['gaussians']:,}",
            f"{row['psnr_db']:.1f}",
            f"{row['ssim']:.2f}",
            f"{row['processor_s'] / 60:.1f}",
            str(row["threads"]),
        ]
        for row in result["photos"].values()
    ]
    return [source(result), "", *grid(head, rows)]
