"""The tables of the pages."""

from __future__ import annotations

import json
import math
import re
from statistics import median
from types import SimpleNamespace as Run
from typing import Any

from bench.known import KNOWN, plain
from bench.report import SECTIONS, grid, reached, source, table
from bench.runner import read
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.simulation.model import names, number
from gaussian_swaying.wind.field import Modulation

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


def _live() -> str:
    kinds = {"vector": "three numbers", "whole": "a whole number"}
    gusts = (kind.live for kind in Modulation.__subclasses__() if kind.__module__.startswith("gaussian_swaying"))
    swaying = {f"wind.modulations.*.{field}" for live in gusts for field in live}
    shown = [name for name in names() if name in swaying or not name.startswith(("forces.", "wind.modulations."))]
    rows = (
        f"`{name}` | {one.unit} | {kinds.get(one.kind, one.range_in_words)} | {'yes' * one.batched} "
        f"| {'yes' * one.differentiable}"
        for name, one in ((name, number(name)) for name in shown)
    )
    return grid("name | unit | range | together in a batch | keeps a gradient", rows)


SECTIONS["numbers"] = _live

# ---- speed.md

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
    wanted = WANTED[_on(run), run.case, run.formulation, run.asked]
    took = f"{run.median_ms:.3g} | {_goal(run.median_ms, wanted)}"
    return f"{_on(run)} | {what} | `{run.formulation}` | {run.particles:,} | {took}"


table(
    "speed.substeps", "substep", "device | what | formulation | points | substep [ms] | wanted [ms] | reached",
    _substep, lambda run: (_on(run), run.case, getattr(run, "formulation", ""), getattr(run, "asked", 0)) in WANTED,
)  # fmt: skip

FRAME_MS = {("frame", 99_846, 0.0125): 5.0, ("frame", 3_750, 0.032): 2.0, ("large", 998_784, 0.0125): 8.0}
"""Goals for a frame on a GPU [ms]."""
table(
    "speed.frames", "frames",
    "device | Gaussians | dx [m] | substeps | picture | frame [ms] | simulation [ms] | rendering [ms] | wanted [ms] "
    "| reached",
    lambda run: f"{_on(run)} | {run.particles:,} | {run.dx_m:g} | {run.substeps:.0f} | {run.width} x {run.height} "
    f"| {run.median_ms:.3g} | {run.simulation_ms:.3g} | {run.rendering_ms:.3g} "
    f"| {_goal(run.median_ms, FRAME_MS.get((run.case, run.particles, run.dx_m)))}",
    lambda run: (_on(run) == "cpu" and run.dx_m == 0.05) or (run.case, run.particles, run.dx_m) in FRAME_MS,
)  # fmt: skip


RUN_S = {("cpu", "flag"): 10.0, ("cpu", "guitar"): 30.0, ("cuda", "guitar"): 8.0}
"""Goals for a whole process [s]."""
table(
    "speed.runs", "runs",
    "device | run | frames | points | substeps | simulation [s] | rendering [s] | process [s] "
    "| with kernels to compile [s] | wanted [s] | reached",
    lambda run: f"{_on(run)} | {run.name} | {run.frames} | {run.particles:,} | {run.substeps:,} "
    f"| {run.wall_s['simulation']:.1f} | {run.wall_s['rendering']:.1f} "
    f"| {run.process_wall_s:.1f} | {run.process_compiling_s:.1f} "
    f"| {_goal(run.process_wall_s, RUN_S.get((_on(run), run.name.split(',')[0])))}",
    lambda run: run.name != "eval",
)  # fmt: skip

# ---- accuracy.md

FLAGS = ("1", "2", "3", "4", "5", "curtain", "light")
WAYS = {"ours": "ours", "particle": "PhysGaussian's way"}
LOSSES = {"trained": "the paper's"} | {
    f"two_views{seed and f'_{seed}'}": f"with two views, seed {seed or 0}" for seed in ("", "1", "2")
}
SPLATS = {"trained": "trained on photos", "two_views": "trained, comparing two views", "made": "made in code"}


def _flags() -> str:
    runs = [run for run in read("flags") if run.variant in WAYS and hasattr(run, "chamfer_share")]
    found = {(run.splats, run.variant, run.flag): run.chamfer_share for run in runs}
    rows = []
    for splats, made in SPLATS.items():
        for way, title in WAYS.items():
            shares = [found.get((splats, way, flag)) for flag in FLAGS]
            known = [share for share in shares if share is not None]
            cells = [DASH if share is None else f"{100 * share:.2f}" for share in [*shares, sum(known) / len(known)]]
            rows.append(" | ".join([made, title, *cells]))
    return grid(" | ".join(["splats", "Chamfer distance [%]", *FLAGS, "mean"]), rows) + "\n\n" + source(runs)


SECTIONS["flags"] = _flags

table(
    "tilts", "tilts", "losses | normals | tilt inside [°] | at the edges [°] | height [mm rms]",
    lambda run: f"{LOSSES[run.splats]} | `{run.normals}` | {run.inside_deg:.2f} | {run.edges_deg:.2f} "
    f"| {run.height_mm:.2f}",
)  # fmt: skip


def _wanted(name: str, low: float, high: float) -> str:
    if low == high:
        return f"{name} {high:.3g}"
    if math.isinf(high):
        return f"{name} at least {low:.3g}"
    return f"{name} at most {high:.3g}" if low in (-high, 0, -math.inf) else f"{name} {low:.3g} to {high:.3g}"


def _known(page: str) -> str:
    """A row for each problem of a page: its finest case. Then all that miss their goal, also of those without a row."""
    runs = {json.dumps(run.parameters, sort_keys=True): run for run in read("known") if not hasattr(run, "failed")}
    rows, shown, missed = [], [], []
    for one in KNOWN:
        cases = [
            (parameters, run)
            for parameters in map(plain, one.fine if (one.page == AIR) == (page == AIR) else ())
            if (run := runs.get(json.dumps({"problem": one.name} | parameters, sort_keys=True))) is not None
        ]
        verdicts = [one.verdicts(vars(run) | parameters, one.goal) for parameters, run in cases]
        good = sum(all(low <= value <= high for value, low, high in found.values()) for found in verdicts)
        shown += [run for _, run in cases]
        if good < len(cases):
            missed.append(f"{re.split('[,:]', one.name)[0]} ({len(cases) - good} of {len(cases)})")
        if one.page == page and cases:
            key, (value, low, high) = next(iter(verdicts[-1].items()))
            rows.append(f"{one.name} | {key} {value:.3g} | {_wanted(key, low, high)} | {good} of {len(cases)}")
    told = f"Of all {len(shown)} recorded cases, these miss their goal: {'; '.join(missed)}."
    head = "problem | measured | wanted | cases that reach it"
    return "\n\n".join([grid(head, rows), told, source(shown)])


AIR = "air.md"
SECTIONS["known.accuracy"] = lambda: _known("accuracy.md")
SECTIONS["known.air"] = lambda: _known(AIR)

# ---- web.md, contact.md

table(
    "speed.pages", "pages",
    "page | Gaussians | points | film [MB] | .sway [MB] | error of a node [% of the size] | page that simulates [MB] "
    "| Node.js [x real time] | with the longest substeps",
    lambda run: f"{run.config} | {run.count:,} | {run.points:,} | {run.bytes / 1e6:.1f} | {run.bundle_bytes / 1e6:.1f} "
    f"| {100 * run.error_of_size:.2g} | {run.page_bytes / 1e6:.1f} | {run.real_time:.2f} | {run.real_time_longest:.2f}",
)  # fmt: skip


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
"""Mean lean of a top in a breeze, gusts and a storm [% of the height], from frequencies and masses of trees that were
measured (Jackson et al. 2021)."""


SWAYING = ("flag", "tree", "sapling", "plant", "guitar")


def _sway() -> str:
    head = "splat, wind | lean, announced, expected [%] | sway / lean | peak, first [Hz] | its share | cross | drift"
    rows = []
    for run in read("sway"):
        name = run.splat.split(".")[0]
        if hasattr(run, "failed") or run.look == "storm" or name not in SWAYING:
            continue
        expected = SWAY.get(run.kind, (None,) * 3)[("breeze", "gusts", "storm").index(run.look)]
        lean = [
            f"{100 * run.lean:.3g}",
            *(DASH if x is None else f"{x:.3g}" for x in (_percent(run.announced), expected)),
        ]
        first = DASH if run.frequency_Hz is None else f"{run.frequency_Hz:.2f}"
        rows.append(
            f"{name}, {run.look} | {', '.join(lean)} | {run.ratio:.2f} | {run.peak:.2f}, {first} "
            f"| {run.peak_share:.2f} | {run.cross:.2f} | {run.drift:.3f}"
        )
    return grid(head, rows)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


GOALS = {"wind.speed": 0.05, "wind.azimuth": 5.0, "material.E": 0.15}


def _small_films() -> str:
    head = "films | fitted | within the goals | good, doubtful, failed | good, but more than twice the goals off | "
    head += "values within two standard errors | processor, median"
    kinds: dict[str, list[Any]] = {}
    for run in read("small_films"):
        if not hasattr(run, "failed"):
            kinds.setdefault(run.kind.replace("_", " "), []).append(run)
    rows = []
    for kind, runs in kinds.items():
        off = [max(abs(run.errors[name]) / goal for name, goal in GOALS.items()) for run in runs]
        verdicts = [run.verdict for run in runs]
        wrong = sum(one > 2 and verdict == "good" for one, verdict in zip(off, verdicts, strict=True))
        near = [abs(deviation) <= 2 for run in runs for deviation in run.deviations.values()]
        told = ", ".join(str(verdicts.count(name)) for name in ("good", "doubtful", "failed"))
        rows.append(
            f"{kind} | {len(runs)} | {sum(one <= 1 for one in off)} | {told} | {wrong} | {sum(near)} of {len(near)} "
            f"| {median(run.processor_s for run in runs):.0f} s"
        )
    return grid(head, rows) + "\n\n" + source(read("small_films"))


def _hand_films() -> str:
    runs = [run for run in read("fit") if "hand_films" in run.case and not hasattr(run, "failed")]
    rows = []
    for run in sorted(runs, key=lambda run: run.case):
        thing, way = run.case.split("/")[-2:]
        speed, azimuth, E = (run.errors[name] for name in ("speed", "azimuth", "E"))
        begins = "at rest" if way == "still" else "in motion"
        told = f"{thing.replace('_', ' ')} {begins} | {100 * speed:+.1f} % | {azimuth:+.1f}° | {100 * E:+.1f} %"
        rows.append(f"{told} | {run.verdict}")
    return grid("film | speed | azimuth | E | verdict", rows) + "\n\n" + source(runs)


SECTIONS["hand_films"] = _hand_films
SECTIONS["small_films"] = _small_films
SECTIONS["sway"] = _sway
SECTIONS["speed.contact"] = _contact
