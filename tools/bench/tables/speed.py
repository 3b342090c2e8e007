"""Tables of ``bench.py speed``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bench.scenes import PLASTIC_TRAFFIC, TRAFFIC, WIND_TRAFFIC
from bench.slots import table
from bench.tables.markdown import gib, grid, source

Row = dict[str, Any]
PAGE = "benchmarks.md"


@table(PAGE, "speed.fewest_numbers", "speed_*", together=True)
def fewest_numbers(_: list[Row]) -> list[str]:
    """How many numbers a substep reads and writes, for the count of the fewest bytes."""
    rows = [
        [f"`{name}`, {what}", str(read), str(written)]
        for name, both in TRAFFIC.items()
        for what, (read, written) in both.items()
    ]
    more = {
        "with wind, extra for a particle": WIND_TRAFFIC,
        "with a plastic law, extra for a particle": PLASTIC_TRAFFIC,
    }
    rows += [[what, str(read), str(written)] for what, (read, written) in more.items()]
    return grid(["numbers of 4 bytes", "read", "written"], rows)


@table(PAGE, "speed.device", "speed_*")
def device(result: Row) -> list[str]:
    """The device, and the speed of a copy on it."""
    lines = [source(result)]
    if result.get("partial"):
        lines += ["", "The run was stopped early: the tables below are incomplete."]
    if result.get("quick"):
        lines += ["", "Recorded with `--quick`: tiny counts, which only show that it runs."]
    copy = result["copy"]
    told = f"A copy of {copy['copy_bytes'] / 2**20:,.0f} MiB within device memory moves "
    told += f"{copy['bytes_per_s'] / 1e9:,.0f} GB/s, counting both reads and writes (median of {copy['repeats']})."
    return [*lines, "", told]


def _cases(head: list[str], rows: list[tuple[str, Row, Callable[[Row], list[str]]]]) -> list[str]:
    """A table whose first column is a label; the second says if a case failed."""
    shown = []
    for label, row, cells in rows:
        failed = [f"failed: {row['failed']}".replace("\n", " ")] if "failed" in row else []
        shown.append([label, *(failed + ["-"] * (len(head) - 2) if failed else cells(row))])
    return grid(head, shown)


@table(PAGE, "speed.substeps", "speed_*")
def substeps(result: Row) -> list[str]:
    """Rollouts: time, bytes, memory and error of a substep."""
    rows = result.get("substep", []) + [row | {"sand": True} for row in result.get("sand", [])]
    head = ["substep", "kernels", "nodes with mass", "median [ms]", "quartiles [ms]", "slope [ms]", "torch [ms]"]
    head += ["fewest bytes [MB]", "bandwidth [GB/s]", "share of the copy [%]", "same, from the slope [%]"]
    head += ["memory [MiB]", "error of positions", "error of velocities"]

    def cells(row: Row) -> list[str]:
        error, torch_path = row["error"] or {}, row["torch"] or {}
        slope = "-" if row["share_graph"] is None else f"{100 * row['share_graph']:.1f}"
        return [
            row["path"],
            f"{row['nodes']:,}",
            _digits(row["median_ms"]),
            f"{_digits(row['quartile_low_ms'])} to {_digits(row['quartile_high_ms'])}",
            _digits(row["graph_ms"]),
            torch_path.get("failed") or _digits(torch_path.get("median_ms")),
            _digits(row["bytes"] / 1e6),
            _digits(row["bytes_per_s"] / 1e9),
            f"{100 * row['share']:.1f}",
            slope,
            "-" if row["memory_bytes"] is None else f"{row['memory_bytes'] / 2**20:,.0f}",
            *(
                error.get("failed") or ("-" if key not in error else f"{error[key]:.1e}")
                for key in ("position", "velocity")
            ),
        ]

    def label(row: Row) -> str:
        what = "block of sand" if row.get("sand") else "sheet in wind"
        steps = f", {row['substeps']} substeps" if "substeps" in row else ""
        return f"`{row['formulation']}`, {what}, {row.get('particles', row['asked']):,} particles{steps}"

    return _cases(head, [(label(row), row, cells) for row in rows])


@table(PAGE, "speed.cubes", "speed_cuda")
def cubes(result: Row) -> list[str]:
    """Elastic cubes in `updated`, with and without walls."""
    known = {(row["asked"], row["turning"], row["walls"]): row for row in result.get("cube", [])}
    shown = []
    for asked in dict.fromkeys(row["asked"] for row in result.get("cube", [])):
        for turning in (False, True):
            rows = [known.get((asked, turning, walls), {}) for walls in (False, True)]
            times = [row.get("failed") or _digits(row.get("median_ms")) for row in rows]
            shown.append(
                [f"{rows[0].get('particles', asked):,}", "turning" if turning else "falling from rest", *times]
            )
    return grid(["points", "motion", "substep [ms]", "with an enclosing box [ms]"], shown)


@table(PAGE, "speed.batches", "speed_*")
def batches(result: Row) -> list[str]:
    """Many flags in one rollout, and one after another."""
    rows = result.get("batch", [])
    head = ["flags", "together [ms]", "one after another [ms]", "one flag as large [ms]"]
    head += ["together [10⁶ particle substeps/s]", "one after another [10⁶/s]", "ratio", "one as large [10⁶/s]"]
    head += ["share of it [%]", "largest difference in positions"]

    def cells(row: Row) -> list[str]:
        times = [_digits(row[name]["median_ms"]) if name in row else "-" for name in ("together", "apart", "large")]
        rates = [_digits(row[name] / 1e6) for name in ("together_per_s", "apart_per_s")]
        large = [_digits(row["large_per_s"] / 1e6), f"{100 * row['share']:.0f}"] if "share" in row else ["-", "-"]
        return [*times, *rates, f"{row['ratio']:.1f}", *large, f"{row['difference']:.1e}"]

    def label(row: Row) -> str:
        size = f"{row['scenes']} of {row['particles']:,} particles, " if "scenes" in row else ""
        steps = f", {row['substeps']} substeps" if "substeps" in row else ""
        return f"{size}`{row['formulation']}`, {'gusts' if row['gusts'] else 'steady winds'}{steps}"

    return _cases(head, [(label(row), row, cells) for row in rows])


@table(PAGE, "speed.frames", "speed_*")
def frames(result: Row) -> list[str]:
    """From the state of a frame to the picture of the next."""
    rows = [*result.get("frame", []), *result.get("large", [])]
    head = ["frame of 0.04 s of configs/sim/flag.yaml", "substeps", "median [ms]", "quartiles [ms]", "simulation [ms]"]
    head += ["shading [ms]", "rendering [ms]", "renderer", "memory [GiB]", "memory to build [GiB]"]

    def cells(row: Row) -> list[str]:
        memory = [row["memory_bytes"], row["build_memory_bytes"]]
        return [
            f"{row['substeps']:g}",
            _digits(row["median_ms"]),
            f"{_digits(row['quartile_low_ms'])} to {_digits(row['quartile_high_ms'])}",
            *(_digits(row[name]) for name in ("simulation_ms", "shading_ms", "rendering_ms")),
            row["renderer"],
            *(gib(value, 3) for value in memory),
        ]

    def label(row: Row) -> str:
        size = f", {row['particles']:,} Gaussians, {row['width']}x{row['height']}" if "particles" in row else ""
        return f"dx = {row['dx_m']:g} m{size}" if "dx_m" in row else "as it is configured"

    return _cases(head, [(label(row), row, cells) for row in rows])


def _digits(value: float | None) -> str:
    """Three digits, without exponents."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
