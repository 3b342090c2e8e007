"""The goals of docs/benchmarks.md: what was wanted, what was measured, and whether the goal is reached."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables import speed_goals
from bench.tables.markdown import gib, grid, yes_no

Row = dict[str, Any]
Goal = tuple[str, str, bool | None, str, bool | None]
"""Goal, measured value, whether it is reached (None: not measured), stretch goal, and whether that is reached."""

GOALS = {
    "flag_cpu": "flag end to end on 2 CPU cores: within 10 s and 2 GB",
    "object_cpu": "captured object, 250 frames at 960x540 on 2 CPU cores, all in: within 180 s",
    "substep_cpu": "one elastic substep of 20,000 particles on 2 CPU cores: within 40 ms",
    "whole": "captured object over 250 frames: no particle lost, singular values of F within [0.5, 2]",
    "process_cuda": "the same, whole process with start-up and files: within 8 s",
    "compare_cuda": "a run of 250 frames compared with a reference on one H200: within 5 s",
    "compare_cpu": "a run of 250 frames compared with a reference on 2 CPU cores: within 30 s",
    "round_trip": "captured object, frame 0 compared with the splat itself: PSNR of at least 35 dB",
    "object_cuda": "captured object, 250 frames at 1920x1080 on one H200, not counting files: within 1.5 s and 2 GiB",
}


def _goal(name: str, measured: str, reached: bool, stretch: str = "-", stretched: bool | None = None) -> Goal:
    return GOALS[name], measured, reached, stretch, stretched


def of_runs(result: Row) -> list[Goal]:
    """Goals of a substep and of whole runs."""
    rows = []
    on_cpu = "CPU" in result["device"]
    for row in result.get("substep", []):
        if on_cpu and row["particles"] < 21_000:
            measured = f"{row['median_ms']:.1f} ms (`{row['formulation']}`)"
            rows.append(_goal("substep_cpu", measured, row["median_ms"] <= 40))
    for run in result.get("runs", []):
        memory = run["peak_memory_bytes"]
        if on_cpu and run["name"].startswith("flag"):
            took, used = run["process_wall_s"], memory["host"] / 1e9
            good, better = (took <= limit and used <= 2 for limit in (10, 5))
            rows.append(_goal("flag_cpu", f"{took:.1f} s, {used:.2f} GB", good, "5 s", better))
        if on_cpu and "960x540" in run["name"] and run["frames"] >= 250:
            took = run["process_wall_s"]
            rows.append(_goal("object_cpu", f"{took:.0f} s", took <= 180, "90 s", took <= 90))
        if not on_cpu and "without_files_s" in run:
            took = run["without_files_s"]
            good, better = (
                run["frames"] >= 250 and took <= limit and memory["device"] <= 2 * 2**30 for limit in (1.5, 1.0)
            )
            rows.append(_goal("object_cuda", f"{took:.2f} s, {gib(memory['device'])} GiB", good, "1 s", better))
        if not on_cpu and "1920x1080" in run["name"] and run["frames"] >= 250:
            took = run["process_wall_s"]
            rows.append(_goal("process_cuda", f"{took:.1f} s", took <= 8, "6 s", took <= 6))
        if run["frames"] >= 250:
            whole = run["lost_particles"] == 0 and run["stretch_min"] >= 0.5 and run["stretch_max"] <= 2
            measured = f"[{run['stretch_min']:.2f}, {run['stretch_max']:.2f}], {run['lost_particles']} lost"
            rows.append(_goal("whole", f"{measured} ({'CPU' if on_cpu else 'GPU'})", whole))
    if result.get("comparison", {}).get("frames", 0) >= 250:
        took, name = result["comparison"]["process_wall_s"], "compare_cpu" if on_cpu else "compare_cuda"
        rows.append(_goal(name, f"{took:.1f} s", took <= (30 if on_cpu else 5)))
    if "round_trip_psnr_db" in result:
        value = result["round_trip_psnr_db"]
        rows.append(_goal("round_trip", f"{value:.1f} dB ({'CPU' if on_cpu else 'GPU'})", value >= 35))
    return rows


@table("benchmarks.md", "goals.table", "s*_*", together=True)
def goals(results: list[Row]) -> list[str]:
    """The goals of all recorded runs."""
    found = [goal for result in results if "copy" not in result for goal in of_runs(result)]
    found += [goal for result in results if "copy" in result for goal in speed_goals.goals(result)]
    rows = [[goal, measured, yes_no(one), stretch, yes_no(two)] for goal, measured, one, stretch, two in found]
    return grid(["goal", "measured", "reached", "stretch goal", "reached"], rows)
