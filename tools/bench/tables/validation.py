"""Tables of validation.md, but for those of ``bench.py accuracy``."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from functools import partial

from bench.cases.backward import LONG, SOUGHT
from bench.cases.pareto import DEFAULT, PROBLEMS, PROVEN_CFL, is_default, on_front, proven
from bench.cases.points import NUDGE, configuration
from bench.tables.markdown import source
from bench.tables.render import BECAUSE, WANTED, Goal, Row, judged, table, value

PAGE = "validation.md"

SHEETS = {"plate": "a plate", "faint plate": "a faint plate", "flag": "a flag", "leafy": "leafy branches",
          "crown": "crowns of leaves", "open ball": "leaves spread over a ball, leaf area index up to 2",
          "dense ball": "the same, leaf area index from 3"}  # fmt: skip
"""How the names of bodies begin that are no closed skins, and what they are."""


def _skins(result: Row) -> Iterator[Row]:
    """The worst closed skin of those that are resolved and of those that are not."""
    off = {name: row["open"] - 1 for name, row in result["bodies"].items() if not name.startswith(tuple(SHEETS))}
    for start, what in (("", "closed skins, with layers, haze and clutter behind them"),
                        ("unresolved: ", "the same, beyond what is resolved")):  # fmt: skip
        worst = max((n for n in off if n.startswith("unresolved: ") == bool(start)), key=lambda n: abs(off[n]))
        yield {"what": what, "off": off[worst], "size": abs(off[worst]), "name": worst.removeprefix(start)}


def _sheets(result: Row) -> Iterator[Row]:
    for kind, what in SHEETS.items():
        found = [row["open"] for name, row in result["bodies"].items() if name.startswith(kind)]
        yield {"what": what, "least": min(found)}


AREA_GOALS = [
    Goal("{what}", "{off:+.1f %} at worst ({name})", "size <= 0.05", _skins,
         more={"wanted": "the area of the skin within {limit:g %}"}),
    Goal("{what}", "{least:.1f %}", "least >= 0.95", _sheets, more={"wanted": "at least {limit:g %} of the area"}),
    Goal("time for {gaussians:,.0f} Gaussians on 2 cores, beyond `coverage`",
         "{open_s:.2f} s, {open_cpu_s:.2f} s of processor time (`coverage`: {coverage_s:.1f} s)", "open_s <= 2",
         lambda result: [result["timed"]], more={"wanted": "at most {limit:g} s"}),
]  # fmt: skip
table(PAGE, "area.goals", "area_*", judged(AREA_GOALS), WANTED.replace("goal", "what", 1), before="{source}")


def _bodies(result: Row) -> Iterator[Row]:
    for name, row in result["bodies"].items():
        yield row | {"name": name, "as": "" if row["known"] else " (as `coverage` finds)"}


table(PAGE, "area.bodies", "area_*", _bodies, """
    body = {name} | Gaussians = {gaussians:,.0f} | area [m²] = {area:.2f}{as} |
    `coverage` = {coverage:.3f} | `open` = {open:.3f}
    """)  # fmt: skip
value("area.capture", "area_*", "{$1.$2:.1f}", lambda result: {
    name: row | {kind: row["area"] * row[kind] for kind in ("coverage", "open")}
    for name, row in result["captures"].items()})  # fmt: skip


def _leaves(result: Row) -> Iterator[Row]:
    """Beside the finest shared grid, which is the reference."""
    rows = {(row["cells"], row["connected"]): row for row in result["rows"]}
    finest = max(cells for cells, connected in rows if connected == "grid")
    for _, row in sorted(rows.items()):
        yield row | {"share": row["relative"] / rows[finest, "grid"]["relative"], "finest": finest}


table(PAGE, "leaves.rows", "leaves_*", _leaves, """
    cells along the longest side = {cells} | `scene.connected` = `{connected}` | points = {points:,} |
    nodes = {nodes:,} | motion of leaves = {motion:.2f %} | against each other = {relative:.2f %} |
    over that of the finest shared grid = {share:.0f %}
    """, before="{source}")  # fmt: skip
LEAVES_GOALS = [
    Goal("leaves at {cells} cells with nodes of their own, motion against each other, over that at {finest} cells",
         "{share:.0f %}", "share >= 0.3", _leaves, "connected is 'surface' and cells < finest",
         {"wanted": "at least {limit:g %}"}),
    Goal("time of a substep at {cells} cells, over that on shared nodes", "{cost:.2f} ({surface_ms:.2f} ms)",
         "cost <= 1.3", "costs", more={"wanted": "at most {limit:g}"}),
    Goal("{simulated_s:g} s at {cells} cells with pictures, on two cores", "{seconds:.0f} s", "seconds <= 120", "runs",
         "connected is 'surface'", {"wanted": "at most {limit:g} s"}),
]  # fmt: skip
table(PAGE, "leaves.goals", "leaves_*", judged(LEAVES_GOALS), WANTED)


def _memory(result: Row, chosen: str) -> list[Row]:
    return [row | {"checkpoint": row["checkpoint"] or chosen} for row in result["memory"]]


def _agreement(result: Row) -> list[Row]:
    both = ("kernels", "torch")
    return [row | row[name] | {"by": name} for row in result["agreement"] for name in both if name in row]


_SIZE = "points = {points:,} | held = {pin or 'no'} | law = {law} | computed by = {by or transfer}"
table(PAGE, "backward.rows", "backward_*", "rows", f"""
    {_SIZE} | without gradient [ms] = {{plain.median_ms:.3g}} | forward [ms] = {{forward.median_ms:.3g}} |
    backward [ms] = {{backward.median_ms:.3g}} | ratio = {{ratio:.1f}}
    """, before="{source}")  # fmt: skip
table(PAGE, "backward.memory", "backward_*", partial(_memory, chosen="chosen"), """
    points = {points:,} | substeps = {steps:,} | computed by = {by or transfer} | `checkpoint` = {checkpoint} |
    memory [GiB] = {memory_bytes:.2f (GiB)} | seconds = {seconds:.2f}
    """)  # fmt: skip
table(PAGE, "backward.agreement", "backward_*", _agreement, f"""
    points = {{points:,}} | held = {{pin}} | float32 by = {{by}} |
    {" | ".join(f"{name} = {{{name}:.1e}}" for name in SOUGHT)}
    """)  # fmt: skip
BACKWARD_GOALS = [
    Goal("backward of a substep of {points:,} points, held: {pin or 'no'}, {law}", "{ratio:.1f}", "ratio <= 4",
         where="points >= 9e4 and by or transfer is 'kernels'", more={"wanted": "at most {limit:g} forward"}),
    Goal("memory of {steps:,} substeps", "{memory_bytes:.2f GiB}", "memory_bytes <= 2147483648", "memory",
         f"by or transfer is 'kernels' and steps >= {LONG}", {"wanted": "at most {limit:g GiB}"}),
]  # fmt: skip
"""Of a sheet of about 100,000 points."""
table(PAGE, "backward.goals", "backward_*", judged(BACKWARD_GOALS), WANTED)

table(PAGE, "gradients.memory", "gradients_*", partial(_memory, chosen="none"), """
    formulation = `{formulation}` | substeps = {substeps} | `checkpoint` = {checkpoint} |
    memory [MiB] = {memory_MiB:.0f} | seconds = {seconds:.1f} | dL/dE = {gradient_E:.6g}
    """, before="{source}")  # fmt: skip


def _fitted(result: Row) -> Iterator[Row]:
    names = ("values", "truth", "guess", "relative_errors")
    for place, title in enumerate(("wind [m/s]", "E [Pa]")):
        yield {"title": title} | {name: result["fit"][name][place] for name in names}


table(PAGE, "gradients.fit", "gradients_*", _fitted, """
    = {title} | found = {values:.6g} | true = {truth:g} | first guess = {guess:g} | error = {relative_errors:.4f %}
    """)  # fmt: skip
value("gradients.noise", "gradients_*", "{fit.noise:g mm}")
value("gradients.fit_seconds", "gradients_*", "{fit.seconds:.0f} s")


MADE = (
    " Recorded by `GAUSSIAN_SWAYING_RECORD=docs/results python -m pytest -m slow tests/problems/test_hard_cases.py "
    "-k ten_minutes`."
)


def _long_runs(found: Row) -> list[Row]:
    """The runs of the long flag, which a slow test of tests/problems/test_hard_cases.py records."""
    return [run for name, run in found.items() if name != "measured"]


def _rises(found: Row) -> Iterator[Row]:
    """Energies of the tenth minute against the second, in standard errors of the difference."""
    for run in _long_runs(found):
        for name, what in (("kinetic_of_particles", "kinetic energy of the particles"),
                           ("mechanical", "mechanical energy")):  # fmt: skip
            energy, error = (run[f"{part}_per_minute_J"][name] for part in ("energy", "standard_error"))
            yield run | {"what": what, "rise": (energy[9] - energy[1]) / math.hypot(error[9], error[1])}


def _growth(found: Row) -> Row:
    """Growth of the mechanical energy of each run per minute, from a linear fit of its logarithm."""
    rates = {}
    for name, run in found.items():
        logarithms = [math.log(energy) for energy in run.get("energy_per_minute_J", {}).get("mechanical", [])]
        if logarithms:
            slope = statistics.linear_regression(range(len(logarithms)), logarithms).slope
            rates[name] = math.expm1(slope)
    return rates


table(PAGE, "long_flag.minutes", "long_flag", _long_runs, """
    damping [1/s] = {damping_per_s} |
    mechanical energy of each minute [J] = {energy_per_minute_J.mechanical:.3g} |
    kinetic energy of the particles [J] = {energy_per_minute_J.kinetic_of_particles:.3g} |
    largest stretch = {largest_stretch:.2f} | torn = {torn} | lost = {lost} | substeps = {substeps:,} |
    seconds = {wall_s:.0f}
    """, before=lambda found: source(found | _long_runs(found)[0]) + MADE)  # fmt: skip
LONG_GOALS = [
    Goal("damping {damping_per_s:g} 1/s: {what} in the tenth minute no higher than in the second", "{rise:+.1f}",
         "rise <= 4", _rises, more={"wanted": "rise of at most {limit:g} standard errors",
         "why": "gusts are stationary; one of 30,000 such differences is larger by chance"}),
]  # fmt: skip
table(PAGE, "long_flag.goals", "long_flag", judged(LONG_GOALS), BECAUSE)
value("long_flag.growth", "long_flag", "{$1:.1f %}", _growth)
value("long_flag.damping", "long_flag", "{$1.damping_per_s:g} 1/s")


def _as_exact(result: Row) -> Iterator[Row]:
    """The default on each grid, with the cheapest proven setting that is at least as accurate."""
    for problem, (_, unit, _) in PROBLEMS.items():
        own = [row for row in result["rows"] if row["problem"] == problem]
        safe = [row for row in own if proven(row)]
        for default in (row for row in own if is_default(row) and row["error"]):
            as_good = [row for row in safe if row["error"] and row["error"] <= default["error"]]
            best = min(as_good, key=lambda row: row["wall_per_simulated_s"])
            step = f"CFL {best['cfl']}" if best["cfl"] else f"substep {best['substep']:.2g} s"
            front = {"safe": on_front(default, safe), "all": on_front(default, own)}
            yield {"unit": unit, "best": best, "default": default, "step": step, "front": front}


def _other_cfl(result: Row) -> Row:
    """Time with another CFL number divided by that with the default: the median over otherwise equal runs."""
    times: dict[tuple[str, float, str], dict[float, float]] = {}
    for row in result["rows"]:
        if row["error"] and row["substep"] is None and row["dtype"] == DEFAULT["dtype"]:
            alike = times.setdefault((row["problem"], row["size"], row["variant"]), {})
            alike[row["cfl"]] = row["wall_per_simulated_s"]
    default, ratios = DEFAULT["cfl"], dict[str, list[float]]()
    for own in times.values():
        for cfl in own if default in own else ():
            ratios.setdefault(str(cfl), []).append(own[cfl] / own[default])
    return {cfl: statistics.median(found) for cfl, found in ratios.items()}


def _adaptive(result: Row) -> Iterator[Row]:
    """The adaptive substep beside fixed ones, on the flag, by their numbers."""
    flag = [row for row in result["rows"] if row["problem"] == "flag" and row["error"]]
    flag = [row for row in flag if row["variant"] == "total" and row["dtype"] == "float32"]
    for row in (row for row in flag if is_default(row)):
        for fixed in (other for other in flag if other["substep"] and other["size"] == row["size"]):
            more = {"times": fixed["substeps"] / row["substeps"], "difference": abs(row["error"] - fixed["error"])}
            yield row | more | {"fixed": fixed}


def _defaults(result: Row) -> Row:
    """The number of grids, and of those on which the default is on the front of the proven settings."""
    fronts = [row["front"]["safe"] for row in _as_exact(result)]
    return {"good": sum(fronts), "all": len(fronts)}


value("pareto.proven_cfl", "pareto_*", "{cfl}", lambda _: {"cfl": PROVEN_CFL})
value("pareto.on_front", "pareto_*", "{good} of {all}", _defaults)
value("pareto.time_at", "pareto_*", "{$1:.2f}", _other_cfl)
table(PAGE, "pareto.device", "pareto_*",
      before="{device}; {stack}; {threads} thread(s).{dates}[[\n\nRecorded with {concurrent}.]]")  # fmt: skip
table(PAGE, "pareto.cheapest", "pareto_*", _as_exact, """
    problem = {default.problem} | size = {default.size} {unit} |
    cheapest proven setting at least as accurate as the default =
    `{best.variant}`, {best.dtype}, {step}, {unit} {best.size} |
    error = {best.error:.2e} | default's error = {default.error:.2e} |
    its time [s/s] = {best.wall_per_simulated_s:.3g} | default's time [s/s] = {default.wall_per_simulated_s:.3g} |
    default on the front of proven settings = {front.safe} | of all settings = {front.all}
    """)  # fmt: skip
table(PAGE, "pareto.adaptive", "pareto_*", _adaptive, """
    flag, dx [m] = {size} | substeps, adaptive, CFL 0.4 = {substeps:,.0f} | substeps of 1e-4 s = {fixed.substeps:,.0f} |
    times as many = {times:.1f} | error = {error:.4f} | error of the fixed substep = {fixed.error:.4f} |
    difference (share of the longer side) = {difference:.5f}
    """)  # fmt: skip

LARGER = f"dx {100 * (NUDGE - 1):.0f} % larger"


def _title(way: str) -> str:
    if way in ("gaussian", "nudged"):
        return {"gaussian": "one point to a Gaussian", "nudged": f"the same, {LARGER}"}[way]
    return f"`grid`, {way.removeprefix('grid ')} along the side of a cell"


def _ways(result: Row) -> Iterator[Row]:
    for row in result["rows"]:
        yield row | {"title": _title(row["way"]), "of": row.get("gaussians") if row["way"] == "gaussian" else None}


def _configured(result: Row) -> Iterator[Row]:
    """The error of each scene as it is configured, and what a slightly larger dx changes; none if it diverged."""
    by = {(row["scene"], row["way"]): row.get("error", math.inf) for row in result["rows"]}
    for scene in dict.fromkeys(row["scene"] for row in result["rows"]):
        configured = configuration(scene, None)["scene"]
        way = "gaussian" if configured.get("points") == "gaussian" else f"grid {configured.get('points_per_cell', 2)}"
        errors = {"error": by.get((scene, way), math.inf), "nudged": by.get((scene, "nudged"), math.inf)}
        told = {
            f"{name}_told": "diverged" if math.isinf(error) else f"{100 * error:.2f} %"
            for name, error in errors.items()
        }
        yield errors | told | {"scene": scene, "title": _title(way)}


table(PAGE, "points.rows", "points_*", _ways, """
    scene = {scene} | points = {title} | number = {points:,}[[ of {of:,} Gaussians]] |
    mean distance = {error or '-':.2f %} | at the end = {error_last or '-':.2f %} | ms a frame = {ms_per_frame:.1f} |
    substeps = {substeps:,}
    """, before="{source}")  # fmt: skip
POINT_GOALS = [
    Goal("{scene}", "{error_told} ({title})", "error <= 0.01", _configured,
         more={"wanted": "at most {limit:g %}", "larger": "{nudged_told}"}),
]  # fmt: skip
table(PAGE, "points.goals", "points_*", judged(POINT_GOALS), f"""
    scene = {{goal}} | goal = {{wanted}} | as configured = {{measured}} | reached = {{reached}} | {LARGER} = {{larger}}
    """)  # fmt: skip
value("points.frames", "points_*", "{frames}", lambda result: result["rows"][0])
