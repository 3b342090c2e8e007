"""Tables of ``bench.py substep`` and ``bench.py sim``."""

from __future__ import annotations

from typing import Any

from bench.slots import table, value
from bench.tables.markdown import gib, grid, source

Row = dict[str, Any]
PAGE = "benchmarks.md"


@table(PAGE, "runs.substep", "substep_*")
def substep(result: Row) -> list[str]:
    """Time of one elastic substep."""
    head = ["elastic substep, sheet, no wind", "grid nodes", "median [ms]", "quartiles [ms]"]
    rows = [
        [
            f"`{row['formulation']}`, {row['particles']:,} particles",
            f"{row['nodes']:,}",
            f"{row['median_ms']:.2f}",
            f"{row['quartile_low_ms']:.2f} to {row['quartile_high_ms']:.2f}",
        ]
        for row in result["substep"]
    ]
    return [source(result), "", *grid(head, rows)]


@table(PAGE, "runs.whole", "sim_*")
def whole(result: Row) -> list[str]:
    """Time and memory of whole runs, and the health of the material."""
    parts = ("simulation", "shading", "rendering", "writing")
    head = ["run", "particles", "frames", "substeps", *(f"{part} [s]" for part in parts)]
    compiled = any("process_compiling_s" in run for run in result["runs"])
    head += ["process [s]", *(["with kernels to compile [s]"] if compiled else [])]
    head += ["host memory [GiB]", "device memory [GiB]"]
    rows = [
        [
            run["name"],
            f"{run['particles']:,}",
            str(run["frames"]),
            f"{run['substeps']:,}",
            *(f"{run['wall_s'][part]:.1f}" for part in parts),
            f"{run['process_wall_s']:.1f}",
            *([f"{run['process_compiling_s']:.1f}"] if compiled else []),
            *(gib(run["peak_memory_bytes"][where]) for where in ("host", "device")),
        ]
        for run in result["runs"]
    ]
    told = [
        f"- {run['name']}: {run['lost_particles']} particles lost, singular values of F in "
        f"[{run['stretch_min']:.2f}, {run['stretch_max']:.2f}], largest CFL number {run['largest_cfl']:.2f}, "
        f"largest mean displacement {run['displacement_mean_max_m']:.3f} m."
        for run in result["runs"]
    ]
    told += [
        f"- {run['name']}: all frames simulated and drawn, without files, in {run['without_files_s']:.2f} s."
        for run in result["runs"]
        if "without_files_s" in run
    ]
    if "round_trip_psnr_db" in result:
        told.append(f"- PSNR of frame 0 compared with the captured splat: {result['round_trip_psnr_db']:.1f} dB.")
    if "comparison" in result:
        one = result["comparison"]
        told.append(
            f"- `gaussian-swaying eval`: {one['frames']} frames of {one['particles']:,} Gaussians and of "
            f"{' x '.join(map(str, one['picture']))} pixels against a surface of {one['points']:,} points in "
            f"{one['process_wall_s']:.1f} s of process time, without a video."
        )
    return [source(result), "", *grid(head, rows), "", *told]


@value("runs.seconds", "sim_*")
def seconds(result: Row, name: str) -> str:
    """The whole process of a run, with start-up and files, and the seconds that it simulates; the name's first word."""
    run = next(run for run in result["runs"] if run["name"].split(",")[0] == name)
    return f"{run['process_wall_s']:.1f} s for {run['simulated_s']:.0f} simulated seconds"
