"""Tables of benchmarks.md: substeps, whole runs, previews, other solvers, and ``bench.py speed``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bench import slots
from bench.scenes import PLASTIC_TRAFFIC, TRAFFIC, WIND_TRAFFIC
from bench.tables.markdown import source
from bench.tables.render import Row, fill, lines, table, value

PAGE = "benchmarks.md"

table(PAGE, "peers.rows", "peers", lambda result: _peers(result["rows"]), """
    what = {case} | solver = {solver} | points: time of a substep [ms] = {times}
    """, before="{note}\n\n{source} {made}")  # fmt: skip


def _peers(rows: list[Row]) -> Iterator[Row]:
    for case, solver in sorted({(row["case"], row["solver"]) for row in rows}):
        own = [row for row in rows if (row["case"], row["solver"]) == (case, solver)]
        yield {"case": case, "solver": solver, "times": "; ".join(fill("{points:,}: {ms:g}", row) for row in own)}


def _turning(results: list[Row]) -> Iterator[Row]:
    """Blocks in a box, of ``bench.py speed``, beside the other solvers that have walls."""
    peers = [row for result in results for row in result.get("rows", []) if "walls included" in row.get("solver", "")]
    ours = [row | {"on": result["device"]} for result in results for row in result.get("cube", []) if row["walls"]]
    for row in sorted(ours, key=lambda row: row["asked"]):
        times = {peer["solver"].split(",")[0]: peer["ms"] for peer in peers if peer["points"] == row["asked"]}
        if times:
            how = "turning" if row["turning"] else "falling from rest"
            ratio = min(times.values()) / row["median_ms"]
            yield row | {"how": how, "peers": times, "ratio": ratio, "reached": ratio >= 1.5}


table(PAGE, "peers.turning", "*pee*", _turning, """
    points = {particles:,} | motion = {how} | ours on = {on} | ours [ms] = {median_ms:.3g} |
    CK-MPM [ms] = {peers.CK-MPM:.3g} | claymore [ms] = {peers.claymore:.3g} |
    the faster one per ours = {ratio:.2f} | 1.5 wanted = {reached}
    """, before="Blocks in a box, the other solvers on an H200:", together=True)  # fmt: skip


def _announced(result: Row) -> Iterator[Row]:
    """Each run: that of a configuration, or the starter of a splat."""
    for name, row in result["previews"].items():
        for kind in ("run", "starter"):
            if kind in row:
                known = {"name": name if kind == "run" else f"{name}, {kind}"}
                yield row | known | {"run": row[kind]}


table(PAGE, "previews.rows", "previews_*", _announced, """
    run = {name}[[, `--preset {preset}`]] | frames = {run.frames} | announced [s] = {run.announced_s:.0f} |
    taken [s] = {run.process_s:.0f} | announced / taken = {run.ratio:.2f} |
    substeps a frame, announced and taken = {run.announced_substeps:.0f}, {run.substeps:.0f}
    """, before="{source}")  # fmt: skip

PREVIEW = {"cpu": 60.0, "cuda": 15.0}
"""Goals: time of the preview of 3,000,000 Gaussians [s], on two cores, and with a GPU and 16 cores."""


def _places(result: Row) -> Iterator[Row]:
    wanted = PREVIEW["cpu" if "CPU" in result["device"] else "cuda"]
    for row in result["places"].values():
        yield row | {"wanted": wanted if row["gaussians"] == 3_000_000 else None}


table(PAGE, "places.rows", "places_*", _places, """
    Gaussians = {gaussians:,} | of the plant = {plant:,} | file [MB] = {file_bytes:.0f (MB)} |
    preview [s] = {preview_s:.0f} | wanted = {wanted:g} | its memory [MB] = {preview_bytes:.0f (MB)} |
    per file = {preview_share:.2f} | the plant comes first = {right_first} | starter [s] = {starter_s or '-':.0f} |
    announced [s] = {starter_announced_s or '-':.0f} | its memory [MB] = {starter_bytes or '-':.0f (MB)} |
    250 frames of 1920 x 1080 [s] = {film_s or '-':.1f}
    """, before="{source}")  # fmt: skip

table(PAGE, "runs.substep", "substep_*", "substep", """
    elastic substep, sheet, no wind = `{formulation}`, {particles:,} particles | grid nodes = {nodes:,} |
    median [ms] = {median_ms:.2f} | quartiles [ms] = {quartile_low_ms:.2f} to {quartile_high_ms:.2f}
    """, before="{source}")  # fmt: skip

_RUN = """
    run = {name} | particles = {particles:,} | frames = {frames} | substeps = {substeps:,} |
    simulation [s] = {wall_s.simulation:.1f} | shading [s] = {wall_s.shading:.1f} |
    rendering [s] = {wall_s.rendering:.1f} | writing [s] = {wall_s.writing:.1f} | process [s] = {process_wall_s:.1f} |
    with kernels to compile [s] = {process_compiling_s or '-':.1f} |
    host memory [GiB] = {peak_memory_bytes.host:.2f (GiB)} | device memory [GiB] = {peak_memory_bytes.device:.2f (GiB)}
    """
_TOLD = {
    "stretch_min": "- {name}: {lost_particles} particles lost, singular values of F in [{stretch_min:.2f}, "
    "{stretch_max:.2f}], largest CFL number {largest_cfl:.2f}, largest mean displacement "
    "{displacement_mean_max_m:.3f} m.",
    "without_files_s": "- {name}: all frames simulated and drawn, without files, in {without_files_s:.2f} s.",
    "round_trip_psnr_db": "- PSNR of frame 0 compared with the captured splat: {round_trip_psnr_db:.1f} dB.",
    "comparison": "- `gaussian-swaying eval`: {comparison.frames} frames of {comparison.particles:,} Gaussians and of "
    "{pixels} pixels against a surface of {comparison.points:,} points in {comparison.process_wall_s:.1f} s of process "
    "time, without a video.",
}
"""What is told of each run, or of the whole record, that has a number."""


@slots.table(PAGE, "runs.whole", "sim_*")
def whole(result: Row) -> list[str]:
    """Time and memory of whole runs, and the health of the material."""
    pixels = {"pixels": " x ".join(map(str, result.get("comparison", {}).get("picture", [])))}
    told = [fill(text, row | pixels) for key, text in _TOLD.items() for row in [*result["runs"], result] if key in row]
    return [source(result), "", *lines(result["runs"], _RUN), "", *told]


value("runs.seconds", "sim_*", "{$1.process_wall_s:.1f} s for {$1.simulated_s:.0f} simulated seconds",
      lambda result: {run["name"].split(",")[0]: run for run in reversed(result["runs"])})  # fmt: skip


def _numbers(_: Any) -> list[Row]:
    """How many numbers a substep reads and writes, for the count of the fewest bytes."""
    found = {f"`{name}`, {what}": both for name, parts in TRAFFIC.items() for what, both in parts.items()}
    found["with wind, extra for a particle"] = WIND_TRAFFIC
    found["with a plastic law, extra for a particle"] = PLASTIC_TRAFFIC
    return [{"what": what, "read": read, "written": written} for what, (read, written) in found.items()]


table(PAGE, "speed.fewest_numbers", "speed_*", _numbers, """
    numbers of 4 bytes = {what} | read = {read} | written = {written}
    """, together=True)  # fmt: skip


@slots.table(PAGE, "speed.device", "speed_*")
def device(result: Row) -> list[str]:
    """The device, and the speed of a copy on it."""
    told = [source(result)]
    if result.get("partial"):
        told += ["", "The run was stopped early: the tables below are incomplete."]
    if result.get("quick"):
        told += ["", "Recorded with `--quick`: tiny counts, which only show that it runs."]
    copy = (
        "A copy of {copy.copy_bytes:,.0f MiB} within device memory moves {copy.bytes_per_s:,.0f GB/s}, counting both "
        "reads and writes (median of {copy.repeats})."
    )
    return [*told, "", fill(copy, result)]


def _rollouts(result: Row) -> Iterator[Row]:
    yield from (row | {"what": "sheet in wind"} for row in result.get("substep", []))
    yield from (row | {"what": "block of sand"} for row in result.get("sand", []))


table(PAGE, "speed.substeps", "speed_*", _rollouts, """
    substep = `{formulation}`, {what}, {particles or asked:,} particles[[, {substeps} substeps]] | kernels = {path} |
    nodes with mass = {nodes:,} | median [ms] = {median_ms:digits} |
    quartiles [ms] = {quartile_low_ms:digits} to {quartile_high_ms:digits} | slope [ms] = {graph_ms:digits} |
    torch [ms] = {torch.failed or torch.median_ms or '-':digits} | fewest bytes [MB] = {bytes:digits (MB)} |
    bandwidth [GB/s] = {bytes_per_s:digits (GB/s)} | share of the copy [%] = {share:.1f (%)} |
    same, from the slope [%] = {share_graph:.1f (%)} | memory [MiB] = {memory_bytes:,.0f (MiB)} |
    error of positions = {error.failed or error.position or '-':.1e} |
    error of velocities = {error.failed or error.velocity or '-':.1e}
    """)  # fmt: skip


def _cubes(result: Row) -> Iterator[Row]:
    for row in result.get("cube", []):
        walls = "with an enclosing box [ms]" if row["walls"] else "substep [ms]"
        yield row | {"motion": "turning" if row["turning"] else "falling from rest", "walls": walls}


table(PAGE, "speed.cubes", "speed_cuda", _cubes, """
    points = {particles or asked:,} | motion = {motion} | *{walls} = {failed or median_ms:digits}
    """)  # fmt: skip


def _batches(result: Row) -> list[Row]:
    return [row | {"winds": "gusts" if row["gusts"] else "steady winds"} for row in result.get("batch", [])]


table(PAGE, "speed.batches", "speed_*", _batches, """
    flags = [[{scenes} of {particles:,} particles, ]]`{formulation}`, {winds}[[, {substeps} substeps]] |
    together [ms] = {together.median_ms:digits} | one after another [ms] = {apart.median_ms:digits} |
    one flag as large [ms] = {large.median_ms or '-':digits} |
    together [10⁶ particle substeps/s] = {together_per_s:digits (10⁶)} |
    one after another [10⁶/s] = {apart_per_s:digits (10⁶)} | ratio = {ratio:.1f} |
    one as large [10⁶/s] = {large_per_s or '-':digits (10⁶)} | share of it [%] = {share or '-':.0f (%)} |
    largest difference in positions = {difference:.1e}
    """)  # fmt: skip


def _frames(result: Row) -> Iterator[Row]:
    for row in [*result.get("frame", []), *result.get("large", [])]:
        size = "[[, {particles:,} Gaussians, {width}x{height}]]"
        yield row | {"what": fill("dx = {dx_m:g} m" + size, row) if "dx_m" in row else "as it is configured"}


table(PAGE, "speed.frames", "speed_*", _frames, """
    frame of 0.04 s of configs/sim/flag.yaml = {what} | substeps = {substeps:g} | median [ms] = {median_ms:digits} |
    quartiles [ms] = {quartile_low_ms:digits} to {quartile_high_ms:digits} | simulation [ms] = {simulation_ms:digits} |
    shading [ms] = {shading_ms:digits} | rendering [ms] = {rendering_ms:digits} | renderer = {renderer} |
    memory [GiB] = {memory_bytes:.3f (GiB)} | memory to build [GiB] = {build_memory_bytes:.3f (GiB)}
    """)  # fmt: skip
