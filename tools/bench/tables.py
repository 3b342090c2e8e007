"""The tables of the pages."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace as Run

from bench.known import KNOWN, plain
from bench.report import SECTIONS, grid, percent, reached, source, table
from bench.runner import read
from gaussian_swaying.mpm.materials import MATERIALS

DASH = "-"


def _on(run: Run) -> str:
    return "cuda" if run.device.startswith("NVIDIA") else "cpu"


# ---- configuration.md


def _materials() -> str:
    head = (
        "name | `E` [Pa] | `nu` | `density` [kg/m³] | `thickness` [mm] | mass [kg/m²] | `solver.damping` [1/s] "
        "| waves [m/s] | read in a source"
    )
    rows = (
        f"`{name}` | {m.E:.1e} | {m.nu} | {m.density:g} | {1e3 * m.thickness:g} | {m.density * m.thickness:.2g} "
        f"| {m.damping:g} | {m.wave_speed:.0f} | {m.source or DASH}"
        for name, m in MATERIALS.items()
    )
    return grid(head, rows)


SECTIONS["materials.known"] = _materials

# ---- benchmarks.md

WANTED = {
    ("cpu", "substep", "total", 20_000): 1.6,
    ("cpu", "substep", "updated", 20_000): 3.0,
    ("cuda", "substep", "total", 100_000): 0.06,
    ("cuda", "substep", "total", 1_000_000): 0.25,
    ("cuda", "substep", "updated", 100_000): 0.09,
    ("cuda", "substep", "updated", 1_000_000): 0.34,
    ("cuda", "sand", "updated", 1_000_000): 0.6,
}
"""Goals for a substep [ms]."""


def _goal(value: float, wanted: float | None) -> str:
    return f"{DASH} | {DASH}" if wanted is None else f"{wanted:g} | {reached(value <= wanted)}"


def _substep(run: Run) -> str:
    what = "sheet in wind" if run.case == "substep" else "block of sand"
    torch = f"{run.torch['median_ms']:.3g}" if run.torch else DASH
    memory = DASH if run.memory_bytes is None else f"{run.memory_bytes / 2**20:,.0f}"
    return (
        f"{_on(run)} | {what} | `{run.formulation}` | {run.particles:,} | {run.median_ms:.3g} | {run.graph_ms:.3g} "
        f"| {torch} | {100 * run.share:.1f} | {memory} "
        f"| {_goal(run.median_ms, WANTED.get((_on(run), run.case, run.formulation, run.asked)))}"
    )


table(
    "speed.substeps", "substep",
    "device | what | formulation | points | substep [ms] | slope [ms] | in torch [ms] | share of the copy [%] "
    "| memory [MiB] | wanted [ms] | reached",
    _substep, lambda run: run.case in ("substep", "sand"),
)  # fmt: skip
table(
    "speed.cubes", "substep", "points | motion | enclosing box | substep [ms]",
    lambda run: f"{run.particles:,} | {'turning' if run.turning else 'falling from rest'} "
    f"| {'yes' if run.walls else 'no'} | {run.median_ms:.3g}",
    lambda run: run.case == "cube",
)  # fmt: skip
table(
    "speed.batches", "batches",
    "device | flags of 4,096 points | formulation | wind | together [10⁶ points/s] | times one after another "
    "| 20 wanted | share of one flag as large | 90 % wanted",
    lambda run: f"{_on(run)} | {run.scenes} | `{run.formulation}` | {'gusts' if run.gusts else 'steady'} "
    f"| {run.together_per_s / 1e6:,.0f} | {run.ratio:.1f} | {reached(run.ratio >= 20) if run.scenes > 4 else DASH} "
    f"| {percent(run.share, 0)} | {reached(run.share >= 0.9)}",
)  # fmt: skip

FRAME_MS = {("frame", 99_846, 0.0125): 5.0, ("frame", 3_750, 0.032): 2.0, ("large", 998_784, 0.0125): 8.0}
"""Goals for a frame on a GPU [ms]."""
table(
    "speed.frames", "frames",
    "device | Gaussians | dx [m] | substeps | picture | frame [ms] | simulation [ms] | shading [ms] | rendering [ms] "
    "| wanted [ms] | reached",
    lambda run: f"{_on(run)} | {run.particles:,} | {run.dx_m:g} | {run.substeps:.0f} | {run.width} x {run.height} "
    f"| {run.median_ms:.3g} | {run.simulation_ms:.3g} | {run.shading_ms:.3g} | {run.rendering_ms:.3g} "
    f"| {_goal(run.median_ms, FRAME_MS.get((run.case, run.particles, run.dx_m)))}",
)  # fmt: skip


def _memory(run: Run, name: str) -> str:
    size = run.peak_memory_bytes[name]
    return DASH if size is None else f"{size / 2**30:.2f}"


RUN_S = {("cpu", "flag"): 10.0, ("cpu", "guitar"): 30.0, ("cuda", "guitar"): 8.0}
"""Goals for a whole process [s]."""
table(
    "speed.runs", "runs",
    "device | run | frames | points | substeps | simulation [s] | rendering [s] | writing [s] | process [s] "
    "| with kernels to compile [s] | memory [GiB] | device memory [GiB] | wanted [s] | reached",
    lambda run: f"{_on(run)} | {run.name} | {run.frames} | {run.particles:,} | {run.substeps:,} "
    f"| {run.wall_s['simulation']:.1f} | {run.wall_s['rendering']:.1f} | {run.wall_s['writing']:.1f} "
    f"| {run.process_wall_s:.1f} | {run.process_compiling_s:.1f} | {_memory(run, 'host')} | {_memory(run, 'device')} "
    f"| {_goal(run.process_wall_s, RUN_S.get((_on(run), run.name.split(',')[0])))}",
    lambda run: run.name != "eval",
)  # fmt: skip
table(
    "speed.blender", "blender",
    "flag | solver | cells | points | steps | solver [s per simulated s] | distance to Blender's finer mesh "
    "| to our finer grid",
    lambda run: f"{run.flag} | {'Blender' if run.solver == 'blender' else run.solver} | {run.cells} | {run.points:,} "
    f"| {run.steps:,} | {run.per_simulated_s:.3g} | {percent(run.to['blender']['chamfer'], 2)} "
    f"| {percent(run.to['ours']['chamfer'], 2)}",
    order=lambda run: (run.flag, run.solver, run.cells),
)  # fmt: skip

# ---- flag_benchmark.md

WAYS = {
    "ours": "ours (`total`, three layers)",
    "to_volume": "ours with volumes of grid cells",
    "to_layer": "... and one layer",
    "to_law": "... and fixed corotated",
    "to_area": "... and equal areas",
    "to_wind": "... and wind without normals",
    "particle": "... and no shading: PhysGaussian's way",
    "own_volumes": "PhysGaussian's way with its own volumes",
    "no_surface": "no surface modelling",
    "no_shading": "no shading",
    "true_normals": "with the reference's normals at rest",
    "neighbours": "normals of neighbouring centres",
}
"""Ways to simulate a flag, each of the upper ones with one change more than the one before."""


def _flags(splats: str, flags: tuple[str, ...]) -> str:
    runs = [run for run in read("flags") if run.splats == splats and hasattr(run, "chamfer_share")]
    found = {(run.variant, run.flag): run for run in runs}

    def cells(way: str, of: tuple[str, ...], name: str, form: str, scale: float) -> str:
        own = [found.get((way, flag)) for flag in of]
        return " | ".join(f"{scale * getattr(run, name):{form}}" if hasattr(run, name) else DASH for run in own)

    seen = tuple(flag for flag in flags if hasattr(found.get(("ours", flag)), "psnr_db"))
    head = " | ".join(["Chamfer distance [%]", *flags, *(f"{flag}, PSNR [dB]" for flag in seen)])
    rows = [
        f"{title} | {cells(way, flags, 'chamfer_share', '.2f', 100)} | {cells(way, seen, 'psnr_db', '.2f', 1)}"
        for way, title in WAYS.items()
        if any((way, flag) in found for flag in flags)
    ]
    return grid(head, rows) + "\n\n" + source([run for run in runs if run.variant in WAYS])


SECTIONS["flags.trained"] = lambda: _flags("trained", ("1", "2", "3"))
SECTIONS["flags.made"] = lambda: _flags("made", ("1", "2", "3", "4", "5", "curtain", "light"))


def _refinement() -> str:
    runs = read("refinement")
    cells = (20, 30, 40, 60, 80)
    found = {(str(run.flag), getattr(run, "cells", 0)): run for run in runs}

    def share(flag: str, size: int) -> str:
        return percent(found[flag, size].chamfer, 2) if (flag, size) in found else DASH

    flags = sorted({str(run.flag) for run in runs})
    head = " | ".join(["flag", *(f"{size} cells" for size in cells), "reference against itself"])
    return grid(head, (" | ".join([flag, *(share(flag, size) for size in (*cells, 0))]) for flag in flags)) + (
        "\n\n" + source(runs)
    )


SECTIONS["flags.refinement"] = _refinement


# ---- validation.md, nature.md, air.md


def _wanted(name: str, low: float, high: float) -> str:
    if low == high:
        return f"{name} {high:.3g}"
    if math.isinf(high):
        return f"{name} at least {low:.3g}"
    return f"{name} at most {high:.3g}" if low in (-high, 0, -math.inf) else f"{name} {low:.3g} to {high:.3g}"


def _setting(value: object) -> str:
    return (
        " and ".join(map(str, value))
        if isinstance(value, list)
        else f"`{value}`"
        if isinstance(value, str)
        else str(value)
    )


def _known(page: str) -> str:
    runs = {json.dumps(run.parameters, sort_keys=True): run for run in read("known")}
    rows, shown = [], []
    for one in KNOWN:
        name = one.name
        for parameters in map(plain, one.fine if one.page == page else ()):
            run = runs.get(json.dumps({"problem": one.name} | parameters, sort_keys=True))
            if run is None or hasattr(run, "failed"):
                continue
            found = one.verdicts(vars(run) | parameters, one.goal)
            setting = ", ".join(
                _setting(value) if key == "variant" else f"{key} {_setting(value)}"
                for key, value in parameters.items() if key != "worst"
            )  # fmt: skip
            measured = ", ".join(f"{key} {value:.3g}" for key, (value, _, _) in found.items())
            wanted = ", ".join(_wanted(key, low, high) for key, (_, low, high) in found.items())
            good = all(low <= value <= high for value, low, high in found.values())
            rows.append(f"{name} | {setting} | {measured} | {wanted} | {reached(good)}")
            shown.append(run)
            name = ""
    return grid("problem | setting | measured | wanted | reached", rows) + "\n\n" + source(shown)


SECTIONS["known.validation"] = lambda: _known("validation.md")
SECTIONS["known.nature"] = lambda: _known("nature.md")
SECTIONS["known.air"] = lambda: _known("air.md")

# ---- wind.md, contact.md, validation.md


table(
    "speed.pages", "pages",
    "page | Gaussians | points | film [MB] | .sway [MB] | error of a node [% of the size] | page that simulates [MB] "
    "| Node.js [x real time] | with the longest substeps",
    lambda run: f"{run.config} | {run.count:,} | {run.points:,} | {run.bytes / 1e6:.1f} | {run.bundle_bytes / 1e6:.1f} "
    f"| {100 * run.error_of_size:.2g} | {run.page_bytes / 1e6:.1f} | {run.real_time:.2f} | {run.real_time_longest:.2f}",
)  # fmt: skip


def _wind(run: Run) -> str:
    ratios = " | ".join(f"{own['ratio']:.2f}" for name, own in run.winds.items() if name in WINDS)
    return f"{_on(run)} | `{run.formulation}` | {run.particles:,} | {run.winds['uniform']['median_ms']:.3g} | {ratios}"


WINDS = ("turbulence", "profile, turbulence", "profile, turbulence, shelter", "cylinder")
table("speed.winds", "winds", " | ".join(["device", "formulation", "points", "uniform gusts [ms]", *WINDS]), _wind)


def _contact() -> str:
    runs = read("contact")
    took = {(run.device, run.asked, run.case): run.median_ms for run in runs}
    cases = ("nothing near", "a fifth in contact", "all in contact")
    rows = []
    for run in runs:
        if run.case == "off":
            ratios = [took[run.device, run.asked, case] / run.median_ms for case in cases]
            told = " | ".join(f"{ratio:.2f}" if ratio <= 1.5 else f"**{ratio:.2f}**" for ratio in ratios)
            rows.append(f"{_on(run)} | {run.points:,} | {run.median_ms:.3g} | {told}")
    return grid(" | ".join(["device", "points", "off [ms]", *cases]), rows) + "\n\n" + source(runs)


# ---- nature.md

# 6.2 m high with 4.9 kg/m² and 0.80 Hz, by the estimate for 20 m, 12 kg/m² and 0.364 Hz: it goes as 1 / (H M f²)
LOW_CONIFER = 20 * 12 * 0.364**2 / (6.2 * 4.9 * 0.80**2)
SWAY = {
    "plant": (7, 38, 70),
    "shrub": (1.6, 11, 33),
    "sapling": (2, 14, 39),
    "tree": (0.8, 6, 19),
    "conifer": tuple(LOW_CONIFER * lean for lean in (0.3, 2.3, 8)),
    "hanging": (3, 18, 54),
    "rigid": (0, 0, 0),
}
"""Mean lean of a top in a breeze, gusts and a storm [% of the height], of the estimates that docs/nature.md names."""


def _sway() -> str:
    head = "splat, wind | lean, announced, expected [%] | sway / lean | peak, first [Hz] | its share | cross | drift"
    rows = []
    for run in read("sway"):
        if hasattr(run, "failed"):
            continue
        expected = SWAY.get(run.kind, (None,) * 3)[("breeze", "gusts", "storm").index(run.look)]
        lean = [
            f"{100 * run.lean:.3g}",
            *(DASH if x is None else f"{x:.3g}" for x in (_percent(run.announced), expected)),
        ]
        first = DASH if run.frequency_Hz is None else f"{run.frequency_Hz:.2f}"
        rows.append(
            f"{run.splat.split('.')[0]}, {run.look} | {', '.join(lean)} | {run.ratio:.2f} | {run.peak:.2f}, {first} "
            f"| {run.peak_share:.2f} | {run.cross:.2f} | {run.drift:.3f}"
        )
    return grid(head, rows)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


SECTIONS["sway"] = _sway
SECTIONS["speed.contact"] = _contact
table(
    "speed.backward", "backward",
    "points | computed by | plain substep [ms] | with a gradient [ms] | backward [ms] | backward over plain, 4 wanted "
    "| memory of 2,000 substeps, 2 GiB wanted",
    lambda run: f"{run.points:,} | {'torch' if run.by == 'torch' else 'kernels'} | {run.plain_ms:.3g} "
    f"| {run.forward_ms:.3g} | {run.backward_ms:.3g} | {run.ratio:.1f} "
    f"| {f'{run.memory_bytes / 2**30:.2f} GiB' if hasattr(run, 'memory_bytes') else DASH}",
)  # fmt: skip
