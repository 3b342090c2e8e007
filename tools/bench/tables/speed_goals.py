"""The goals of ``bench.py speed`` on an H200: times in ms; the second number of a pair is the stretch goal."""

from __future__ import annotations

from typing import Any

from bench.cases.speed import FORMULATIONS

Row = dict[str, Any]

SUBSTEP_GOALS = {
    ("total", 100_000): (0.06, 0.03),
    ("total", 1_000_000): (0.25, 0.12),
    ("updated", 100_000): (0.09, 0.05),
    ("updated", 1_000_000): (0.34, 0.20),
}
SCALING_GOAL = (1.1, 1.0)
SAND_GOAL = (1_000_000, (0.6, 0.4))
BATCH_GOAL, SHARE_GOAL = 20.0, (90.0, 100.0)  # %
FRAME_GOAL = (5.0, 3.5)
SMALL_FRAME_GOAL = (2.0, 1.0)
LARGE_FRAME_GOAL, LARGE_SUBSTEP_GOAL = (8.0, 5.0), (0.03, 0.02)
CUBE_GOALS = {False: (0.32, 0.27), True: (0.35, 0.28)}  # without and with walls
MEMORY_GOAL = (0.3, 0.15)  # GiB

Goal = tuple[str, str, bool | None, str, bool | None]  # as in goals.py


def goals(result: Row) -> list[Goal]:
    """The goals of a recorded run on a GPU; none for a CPU."""
    if result["kind"] != "cuda":
        return []

    def find(section: str, **wanted: Any) -> Row | None:
        matching = [r for r in result.get(section, []) if all(r.get(k) == v for k, v in wanted.items())]
        return matching[0] if matching else None

    def goal(text: str, row: Row | None, key: str, limits: tuple[float, float], unit: str, scale: float = 1.0) -> Goal:
        """At most the first limit, and as a stretch goal the second."""
        text = f"one H200: {text} within {limits[0]:g} {unit}"
        stretch = f"{limits[1]:g} {unit}"
        if row is None or "failed" in row or row.get(key) is None:
            failed = None if row is None or "failed" not in row else False
            return text, "not measured" if row is None else row.get("failed", "-"), failed, stretch, failed
        value = row[key] * scale
        return text, f"{value:.3g} {unit}", value <= limits[0], stretch, value <= limits[1]

    found = []
    for (name, asked), limits in SUBSTEP_GOALS.items():
        row = find("substep", formulation=name, asked=asked)
        found.append(goal(f"substep of {asked:,} particles in wind, `{name}`,", row, "median_ms", limits, "ms"))
    for name in FORMULATIONS:
        one, ten = (find("substep", formulation=name, asked=n) for n in (1_000_000, 10_000_000))
        row = ten if one is not None and "failed" not in one else one
        if one is not None and ten is not None and "failed" not in one | ten:
            row = {"ratio": ten["median_ms"] / one["median_ms"] / 10}
        text = f"substep of 10,000,000 particles in wind, `{name}`, compared with ten substeps of 1,000,000,"
        found.append(goal(text, row, "ratio", SCALING_GOAL, "times"))
    asked, limits = SAND_GOAL
    found.append(goal(f"substep of {asked:,} particles of sand", find("sand", asked=asked), "median_ms", limits, "ms"))
    for walls, limits in CUBE_GOALS.items():
        what = f"substep of a falling cube of 1,000,000 points, `updated`, {'in a box' if walls else 'no walls'},"
        found.append(goal(what, find("cube", asked=1_000_000, turning=False, walls=walls), "median_ms", limits, "ms"))
    for name in FORMULATIONS:
        for gusts in (False, True):
            text = f"one H200: many flags at once, `{name}`, {'gusts' if gusts else 'steady winds'}: throughput"
            text += f" {BATCH_GOAL:g} times that of one flag after another"
            row = find("batch", formulation=name, gusts=gusts)
            if row is None or "failed" in row:
                found.append((text, "not measured" if row is None else row["failed"], row and False, "-", None))
            else:
                found.append((text, f"{row['ratio']:.1f} times", row["ratio"] >= BATCH_GOAL, "-", None))
                if "share" in row:
                    share, text = 100 * row["share"], text.rsplit(": ", 1)[0]
                    text += f": {SHARE_GOAL[0]:g} % of the throughput of one flag as large"
                    reached, stretched = (share >= limit for limit in SHARE_GOAL)
                    found.append((text, f"{share:.0f} %", reached, f"{SHARE_GOAL[1]:g} %", stretched))
    row = find("frame", main=True)
    what = "frame of a flag of 100,000 Gaussians at 1920x1080"
    found.append(goal(what, row, "median_ms", FRAME_GOAL, "ms"))
    small = "frame of the flag as it is configured, at 480x270,"
    found.append(goal(small, find("frame", small=True), "median_ms", SMALL_FRAME_GOAL, "ms"))
    large = find("large")
    what = "frame of a flag of 1,000,000 Gaussians at 1920x1080"
    found.append(goal(what, large, "median_ms", LARGE_FRAME_GOAL, "ms"))
    found.append(goal("substep of such a flag in wind, looks included,", large, "substep_ms", LARGE_SUBSTEP_GOAL, "ms"))
    found.append(goal("device memory of a frame of 100,000 Gaussians", row, "memory_bytes", MEMORY_GOAL, "GiB", 2**-30))
    return found
