"""Tables of training.md and from_photos.md: ``bench.py train`` and ``bench.py surfaces``."""

from __future__ import annotations

import statistics
from collections.abc import Iterator

from bench.cases.surfaces import WAYS
from bench.cases.trained import NORMALS, SIZES
from bench.cases.training import FLAG_ROWS, FOX_VARIANTS
from bench.tables.render import GOAL, Goal, Row, judged, table, value

PAGE = "training.md"


def _alike(result: Row) -> dict[str, Row]:
    """The variants that ran alone, as the pairs did, by title; others come from another session and slower code."""
    variants = result.get("variants", {}).items()
    alone = {name: row for name, row in variants if "failed" not in row and row.get("runs_per_device", 1) == 1}
    return {FOX_VARIANTS[name][0]: row for name, row in alone.items()}


def _pair(result: Row) -> Iterator[Row]:
    """Lightning beside the bare loop, by medians, and the best variant beside both."""
    pair = result.get("pair", {})
    if pair.get("bare") and pair.get("lightning"):
        medians = {name: {key: statistics.median(row[key] for row in rows) for key in ("psnr_db", "seconds")}
                   for name, rows in pair.items() if rows}  # fmt: skip
        bare, ours = medians["bare"], medians["lightning"]
        row = {"gain": ours["psnr_db"] - bare["psnr_db"], "ratio": ours["seconds"] / bare["seconds"]}
        row["memory"] = max(one["memory_bytes"] for one in pair["lightning"])
        each = [one["psnr_db"] for one in pair["bare"]]
        if variants := _alike(result):
            best = max(variants, key=lambda name: variants[name]["psnr_db"])
            row |= {"best": best, "above": variants[best]["psnr_db"] - bare["psnr_db"], "spread": max(each) - min(each)}
        yield row


def _lossy(result: Row) -> Iterator[Row]:
    row = result.get("flag", {}).get("flag:settled", result.get("flag", {}).get("flag:size"))
    if row and "failed" not in row:
        yield {"runs_per_device": 1} | row


GOALS = [
    Goal("capture: test PSNR at most 0.1 dB below the bare loop", "{gain:+.2f} dB", "gain >= -0.1", _pair),
    Goal("capture: at most {limit:g} times as long as the bare loop", "{ratio:.2f} times", "ratio <= 1.05", _pair),
    Goal("capture: faster than the bare loop", "{ratio:.2f} times", "ratio < 1", _pair),
    Goal("capture: GPU memory within 1 GiB", "{memory:.2f GiB}", "memory <= 1073741824", _pair),
    Goal("capture: a variant measured in the same way is above the bare loop by more than its runs differ",
         "{above:+.2f} dB ({best})", "above > spread", _pair),
    Goal("flag, all losses: {steps:,} images within {limit:g} s", "{seconds:.0f} s ({runs_per_device} at a time)",
         "seconds <= 300", _lossy),
    Goal("flag, all losses: PSNR of at least {limit:g} dB", "{psnr_db:.1f} dB", "psnr_db >= 35", _lossy),
    Goal("flag, all losses: median angle between patch and true normal within {limit:g}°", "{angle_median_deg:.1f}°",
         "angle_median_deg <= 5", _lossy),
]  # fmt: skip
table(PAGE, "training.goals", "train_cuda", judged(GOALS), GOAL, before="{source}")


def _runs(result: Row) -> Iterator[Row]:
    for name, rows in result.get("pair", {}).items():
        yield from (row | {"name": f"{name}, run {number}"} for number, row in enumerate(rows, 1))
    for name, row in result.get("variants", {}).items():
        yield row | {"name": FOX_VARIANTS[name][0]}


table(PAGE, "training.capture", "train_cuda", _runs, """
    run = {name} | PSNR [dB] = {psnr_db:.2f} | SSIM = {ssim:.3f} | Gaussians = {gaussians:,} |
    seconds = {seconds:.1f} | GPU memory [GiB] = {memory_bytes:.2f (GiB)} |
    runs per GPU = {runs_per_device or '1'}
    """)  # fmt: skip
value("training.spread", "train_*", "{$1:.2f} dB", lambda result: {
    name: max(row["psnr_db"] for row in rows) - min(row["psnr_db"] for row in rows)
    for name, rows in result["pair"].items() if rows})  # fmt: skip


def _gains(result: Row) -> list[Row]:
    """The variants measured as the bare loop was, sorted by their gain over the mean of its runs."""
    if not (bare := [row["psnr_db"] for row in result.get("pair", {}).get("bare", [])]):
        return []
    found = [{"name": name, "gain": row["psnr_db"] - statistics.mean(bare)} for name, row in _alike(result).items()]
    return sorted(found, key=lambda row: -row["gain"])


table(PAGE, "training.gains", "train_cuda", _gains, "- {gain:+.2f} dB {name}")


def _losses(result: Row) -> Iterator[Row]:
    for name, (title, _) in FLAG_ROWS.items():
        row = result.get("flag", {}).get(f"flag:{name}")
        if row is not None and "failed" not in row:
            yield row | {"title": title}


table(PAGE, "training.flag", "train_cuda", _losses, """
    losses = {title} | round = {round_share:.1f %} | decided = {decided_share:.1f %} | small = {small_share:.1f %} |
    angle to true normal: median, 90 % [°] = {angle_median_deg:.1f}, {angle_p90_deg:.1f} |
    distance: median, 90 % [mm] = {distance_median_m:.2f (mm)}, {distance_p90_m:.2f (mm)} |
    area `paper` = {area_paper_ratio:.2f} | area `coverage` = {area_coverage_ratio:.2f} | PSNR [dB] = {psnr_db:.2f} |
    Gaussians = {gaussians:,} | seconds = {seconds:.0f}
    """)  # fmt: skip
table("from_photos.md", "training.photos", "train_cpu", "photos", """
    photos = {photos} | size = {width} x {height} | images = {steps:,} | Gaussians = {gaussians:,} |
    PSNR [dB] = {psnr_db:.1f} | SSIM = {ssim:.2f} | processor time [min] = {processor_s:.1f (min)} |
    threads = {threads}
    """, before="{source}")  # fmt: skip


def _seeds(result: Row, way: str) -> list[Row]:
    return [row for _, row in sorted(result["rows"].get(way, {}).items()) if "tilt" in row]


def _tilts(result: Row) -> Iterator[Row]:
    """Each way to train, for each kind of normals, one value for each seed."""
    for way, (title, _) in WAYS.items():
        runs = _seeds(result, way)
        for place, (normals, origin) in enumerate(NORMALS.items() if runs else ()):
            row = {name: [run["tilt"][normals][name] for run in runs] for name in runs[0]["tilt"][normals]}
            row |= {"title": "", "origin": origin, "chamfer": [run["chamfer"][normals] for run in runs]}
            once = {
                "title": title,
                "height": [run["tilt"]["height_rms_mm"] for run in runs],
                "psnr_db": [run["psnr_db"] for run in runs if run["psnr_db"]],
                "seconds": [run["seconds"] for run in runs if "seconds" in run],
            }
            yield row | (once if place == 0 else dict.fromkeys(once, ""))


def _meant(result: Row) -> Iterator[Row]:
    """The way that is meant to reach the goals: the first that was measured counts."""
    runs = next((found for way in ("fade", "views") if (found := _seeds(result, way))), [])
    plain = _seeds(result, "paper")
    if runs:
        row = {"pattern": result["pattern"], "share": [run["chamfer"]["neighbours"] for run in runs]}
        row["tilt"] = [run["tilt"]["neighbours"]["tilt_40cm_deg"] for run in runs]
        if len(plain) == len(runs) and all("seconds" in run and run["psnr_db"] for run in [*plain, *runs]):
            pairs = list(zip(plain, runs, strict=True))
            row["lost"] = [before["psnr_db"] - run["psnr_db"] for before, run in pairs]
            row["times"] = [run["seconds"] / before["seconds"] for before, run in pairs]
        yield row


SURFACE_GOALS = [
    Goal("tilt over 40 cm at most {limit:g}°", "{tilt:.2f °}", "tilt <= 0.1"),
    Goal("pattern {pattern}: Chamfer distance at most {limit:g %} of the longer side", "{share:.2f %}",
         "share <= 0.02"),
    Goal("PSNR at most {limit:g} dB lower", "{lost:.2f dB}", "lost <= 0.2"),
    Goal("training at most {limit:g} times as long", "{times:.2f times}", "times <= 1.6"),
]  # fmt: skip
"""With the two-view losses and normals of neighbouring centres."""
table(PAGE, "surfaces.goals", "surfaces_*", judged(SURFACE_GOALS, _meant), """
    goal = {goal} | measured, one value for each seed = {measured} | reached = {reached}
    """, before="{source}")  # fmt: skip
_SIZES = " | ".join(f"tilt over {s} cm [°] = {{tilt_{s}cm_deg:.2f}}" for s in (round(100 * size) for size in SIZES))
table(PAGE, "surfaces.rows", "surfaces_*", _tilts, f"""
    losses = {{title}} | normals = {{origin}} | {_SIZES} | median angle [°] = {{median_deg:.2f}} |
    height [mm rms] = {{height:.2f}} | Chamfer [%] = {{chamfer:.2f (%)}} | PSNR [dB] = {{psnr_db:.1f}} |
    seconds = {{seconds:.0f}}
    """, before="Pattern {pattern} of the flag benchmark, {steps:,} images, {at_once} training runs at a time on "
    "the GPU, one value for each seed.")  # fmt: skip
table(PAGE, "surfaces.limits", "surfaces_*", "limits", """
    cameras = {key} ({all_views}) | see the patch = {views:.0f} | height [mm] = {height:.4f (mm)} |
    height, windows of a photo err alike [mm] = {height_common:.3f (mm)} | tilt over 40 cm [°] = {tilt_deg:.4f}
    """)  # fmt: skip
