"""Tables and goals of ``bench.py air``."""

from __future__ import annotations

import math
from collections.abc import Iterator

from bench.tables.render import WANTED, Goal, Row, judged, table

PAGE = "air.md"


def _of(result: Row, problem: str) -> list[Row]:
    found = [row["parameters"] | row["result"] for row in result.get("rows", []) if row["problem"] == problem]
    return [row for row in found if "failed" not in row]


def _order(result: Row, problem: str) -> list[Row]:
    """The order of convergence of the two finest grids."""
    found = sorted(_of(result, problem), key=lambda row: row["cells"])[-2:]
    if len(found) < 2:
        return []
    (coarse, fine) = found
    order = math.log(coarse["error"] / fine["error"]) / math.log(fine["cells"] / coarse["cells"])
    return [fine | {"order": order}]


def _finest(result: Row, problem: str, known: float | None = None, name: str = "drag") -> list[Row]:
    found = sorted(_of(result, problem), key=lambda row: row["cells"])[-1:]
    return [row | ({} if known is None else {"off": row[name] / known - 1}) for row in found]


def _known(result: Row, problem: str, known: float, name: str = "drag") -> list[Row]:
    return [row | {"off": row[name] / known - 1} for row in _of(result, problem)]


def _flat(result: Row) -> list[Row]:
    """Flows with an exact or a published solution, one number each."""
    named = {
        "vortices": "vortices that decay, relative error of the velocity",
        "walls": "flow between walls, relative error of the velocity",
        "cavity": "cavity with a moving lid, Re 100, largest difference from Ghia and others, per speed of the lid",
    }
    return [row | {"name": text} for problem, text in named.items() for row in _of(result, problem)]


table(PAGE, "air.exact", "air_cpu", _flat, """
    flow = {name} | cells = {cells} | found = {error:.5f}
    """, before="{source}", empty="")  # fmt: skip


def _bodies(result: Row) -> list[Row]:
    known = {"cylinder": (1.34, "1.33 to 1.35"), "sphere": (1.09, "1.09"), "plate": (1.2, "1.2 to 1.3")}
    return [
        row | {"name": problem, "published": text, "off": row["drag"] / number - 1}
        for problem, (number, text) in known.items()
        for row in _of(result, problem)
    ]


table(PAGE, "air.bodies", "air_*", _bodies, """
    body = {name} | cells across it = {cells} | drag = {drag:.3f} | published = {published} | Strouhal number =
    [[{strouhal:.4f}]] | box [sizes of the body] = [[{length} long, {width} wide]]
    """, before="{source}", empty="")  # fmt: skip
table(PAGE, "air.inverted", "air_cpu", lambda result: _of(result, "inverted flag"), """
    stiffness B / (rho U² L³) = {stiffness:g} | amplitude from peak to peak [lengths] = {amplitude:.2f} |
    mean place of the free end = {mean:.2f}
    """, empty="")  # fmt: skip
table(PAGE, "air.filaments", "air_cpu", lambda result: _of(result, "hanging filament"), """
    cells in its length = {cells} | amplitude from peak to peak [lengths] = {amplitude:.3f} |
    frequency [U / L] = {frequency:.3f} | drag = {drag:.3f}
    """, empty="", before="The hanging filament of Huang, Shin and Sung (2007), of mass ratio 1.5, at a Reynolds "
    "number of 200 and gravity 0.5 along the flow. They give no table, so this shows only how it depends on the cells:",
    )  # fmt: skip
table(PAGE, "air.onset", "air_cpu", lambda result: _of(result, "onset"), """
    mass ratio = {mass_ratio:g} | cells in its length = {cells} | stiffness at the onset, linear theory = {linear:.4f} |
    found = {found:.4f} | speed at the onset, per that of the theory = {speed:.2f}
    """, empty="", before="The stiffness below which a clamped flag flutters, at a Reynolds number of 1000, beside the "
    "linear theory of an ideal flow (vortices on the flag and in its wake, `tools/bench/problems/flutter.py`):",
    )  # fmt: skip


def _falls(result: Row) -> Iterator[Row]:
    """Each plate, and whether it does what it does in experiments: it flutters below a Froude number of 0.67."""
    for row in _of(result, "falling plate"):
        light = row["froude"] < 0.67
        does = "flutters" if row["swing"] < math.pi - 0.1 else "tumbles" if row["turns"] >= 1 else "turns over at times"
        known = "flutters" if light else "tumbles"
        yield row | {"known": known, "does": does, "right": does == known, "degrees": math.degrees(row["swing"])}


table(PAGE, "air.falling", "air_cpu", _falls, """
    Froude number = {froude:g} | in experiments it = {known} | here it = {does} | whole turns = {turns:.1f} |
    largest angle before a half turn [degrees] = {degrees:.0f}
    """, empty="", before="A rigid plate that falls, in a plane at a Reynolds number of 500. Below a Froude number of "
    "0.67 it flutters in experiments, above it tumbles (Belmonte and others 1998):",
    )  # fmt: skip
table(PAGE, "air.square", "air_*", lambda result: _of(result, "square flag"), """
    cells in a side = {cells} | width of the box [sides] = {width} |
    amplitude from peak to peak [sides] = {amplitude:.3f} |
    frequency [U / L] = {frequency:.3f}
    """, empty="", before="The square flag in three dimensions, at a Reynolds number of 200 and mass ratio 1, a sheet "
    "of the package. Published are an amplitude of 0.78 and a frequency of 0.26 (Huang and Sung 2010), 0.81 and 0.27 "
    "(Tian and others 2014):\n\n{source}",
    )  # fmt: skip
table(PAGE, "air.step", "air_cpu", lambda result: _of(result, "step"), """
    cells in the height of the channel = {cells} | length of the bubble [heights of the step] = {bubble:.2f}
    """, empty="", before="The bubble behind a step of half the height of a channel, at a Reynolds number of 200, is "
    "4.98 heights of the step long (Erturk 2008):",
    )  # fmt: skip


def _couplings(result: Row) -> Iterator[Row]:
    for row in _of(result, "coupling"):
        times = {name: 1e3 * row[f"{name}_s"] for name in ("alone", "coupled")}
        yield row | times | {"name": " x ".join(map(str, row["size"]))}


table(PAGE, "air.coupling", "air_*", _couplings, """
    cells = {name} | points = {points:,.0f} | step without a sheet [ms] = {alone:.3f} | with one [ms] = {coupled:.3f} |
    share of the coupling = {share:.0f %}
    """, before="{source}", empty="")  # fmt: skip
table(PAGE, "air.tandem", "air_cpu", lambda result: _of(result, "two flags"), """
    gap [lengths] = {gap:g} | drag of the first per that of one alone = {first:.2f} | of the second = {second:.2f}
    """, empty="", before="Two flags in a plane, one behind the other, of mass ratio 1.5 and stiffness 0.001. In "
    "experiments the first one has less drag than alone, the less the closer they are, and the second one more "
    "(Ristroph and Zhang 2008):",
    )  # fmt: skip


def _costs(result: Row) -> Iterator[Row]:
    """The error of each problem beside the seconds that it took."""
    errors = {
        "vortices": ("vortices that decay, velocity", lambda r: r["error"]),
        "walls": ("flow between walls, velocity", lambda r: r["error"]),
        "cavity": ("cavity, velocity per speed of the lid", lambda r: r["error"]),
        "cylinder": ("cylinder, Strouhal number", lambda r: abs(r["strouhal"] / 0.1645 - 1)),
        "sphere": ("sphere, drag", lambda r: abs(r["drag"] / 1.09 - 1)),
        "square flag": ("square flag, amplitude", lambda r: abs(r["amplitude"] / 0.78 - 1)),
    }
    for row in result.get("rows", []):
        if row["problem"] in errors and "seconds" in row and "failed" not in row["result"]:
            name, error = errors[row["problem"]]
            found = {"name": name, "error": error(row["result"]), "seconds": row["seconds"]}
            yield row["parameters"] | found


table(PAGE, "air.cost", "air_*", _costs, """
    problem = {name} | cells = {cells} | error = {error:.2f %} | time [s] = {seconds:.1f}
    """, before="Speed against error, with the start of a problem:\n\n{source}", empty="")  # fmt: skip


def _sizes(result: Row) -> list[Row]:
    return [row | {"name": " x ".join(map(str, row["size"]))} for row in _of(result, "flow")]


table(PAGE, "air.speed", "air_*", _sizes, """
    cells = {name} | million updates a second = {updates_per_s:.0f (10⁶)} | bytes for a cell = {bytes_per_cell}
    """, before="{source}", empty="")  # fmt: skip


def _regimes(result: Row) -> list[Row]:
    found = {row["stiffness"]: row for row in _of(result, "inverted flag")}
    return [found[0.2] | {"stiff": found[0.5]["amplitude"]}] if {0.2, 0.5} <= set(found) else []


def _onsets(result: Row) -> Iterator[Row]:
    """Of each mass ratio the finest grid."""
    rows = {row["mass_ratio"]: row for row in sorted(_of(result, "onset"), key=lambda row: row["cells"])}
    yield from (row for _, row in sorted(rows.items()))


table(PAGE, "air.large", "air_cuda", judged([
    Goal("sphere, Re 100, {cells} cells, box {length} x {width} x {width}", "{drag:.3f}", "|off| <= 0.03",
         lambda r: _known(r, "sphere", 1.09), more={"wanted": "drag of 1.09 within 3 %"}),
    Goal("cylinder, Re 100, {cells} cells", "{strouhal:.4f}", "|off| <= 0.03",
         lambda r: _finest(r, "cylinder", 0.1645, "strouhal"), more={"wanted": "Strouhal number of 0.1645 within 3 %"}),
    Goal("square plate across the flow, Re 300, {cells} cells", "{drag:.2f}", "drag >= 1.08 and drag <= 1.43",
         lambda r: _finest(r, "plate"), more={"wanted": "1.2 to 1.3 within 10 %"}),
    Goal("square flag, {cells} cells, amplitude", "{amplitude:.2f}", "|off| <= 0.1",
         lambda r: _finest(r, "square flag", 0.78, "amplitude"), more={"wanted": "0.78 within 10 %"}),
    Goal("square flag, {cells} cells, frequency", "{frequency:.3f}", "|off| <= 0.1",
         lambda r: _finest(r, "square flag", 0.26, "frequency"), more={"wanted": "0.26 within 10 %"}),
    Goal("128 x 96 x 96 cells", "{updates_per_s:.0f (10⁶)} million", "updates_per_s >= 1.5e9",
         lambda r: _of(r, "flow")[-1:], more={"wanted": "1,500 million updates a second"}),
    Goal("share of the coupling, 128 x 96 x 96 cells, {points:,.0f} points", "{share:.0f %}", "share <= 0.2",
         lambda r: _of(r, "coupling")[-1:], more={"wanted": "at most 20 %"}),
    ]), WANTED, empty="")  # fmt: skip
table(PAGE, "air.goals", "air_cpu", judged([
    Goal("vortices that decay, order of convergence", "{order:.2f}", "order >= 1.8", lambda r: _order(r, "vortices"),
         more={"wanted": "second order"}),
    Goal("flow between walls, order of convergence", "{order:.2f}", "order >= 1.8", lambda r: _order(r, "walls"),
         more={"wanted": "second order"}),
    Goal("cavity, {cells} cells", "{error:.3f}", "error <= 0.01", lambda r: _finest(r, "cavity"),
         more={"wanted": "within 0.01 of Ghia and others"}),
    Goal("cylinder, Re 100, {cells} cells", "{strouhal:.4f}", "|off| <= 0.03",
         lambda r: _finest(r, "cylinder", 0.1645, "strouhal"), more={"wanted": "Strouhal number of 0.1645 within 3 %"}),
    Goal("square plate across the flow, Re 300, {cells} cells", "{drag:.2f}", "drag >= 1.08 and drag <= 1.43",
         lambda r: _finest(r, "plate"), more={"wanted": "1.2 to 1.3 within 10 %"}),
    Goal("bubble behind a step, Re 200, {cells} cells", "{bubble:.2f} heights", "|off| <= 0.05",
         lambda r: _finest(r, "step", 4.982, "bubble"), more={"wanted": "4.98 heights within 5 % (Erturk 2008)"}),
    Goal("onset of flutter, mass ratio {mass_ratio:g}", "{speed:.2f} times", "speed >= 0.85 and speed <= 1.15",
         _onsets, more={"wanted": "the speed of linear theory within 15 %"}),
    Goal("falling plate, Froude number {froude:g}", "{does}", "right is True",
         _falls, more={"wanted": "flutters below 0.67, tumbles above (Belmonte and others 1998)"}),
    Goal("square flag, {cells} cells, amplitude", "{amplitude:.2f}", "|off| <= 0.1",
         lambda r: _finest(r, "square flag", 0.78, "amplitude"), more={"wanted": "0.78 within 10 %"}),
    Goal("square flag, {cells} cells, frequency", "{frequency:.3f}", "|off| <= 0.1",
         lambda r: _finest(r, "square flag", 0.26, "frequency"), more={"wanted": "0.26 within 10 %"}),
    Goal("inverted flag: straight at a stiffness of 0.5, flaps at 0.2", "{stiff:.2f}, {amplitude:.2f}",
         "stiff <= 0.1 and amplitude >= 0.5", _regimes, more={"wanted": "as in experiments"}),
    Goal("`flag_in_air`, a frame", "{frame_s:.2f} s", "frame_s <= 1", lambda r: _of(r, "scene"),
         more={"wanted": "a second on two CPU cores"}),
    Goal("memory for a cell", "{bytes_per_cell} bytes", "bytes_per_cell <= 200", lambda r: _of(r, "flow")[:1],
         more={"wanted": "at most 200 bytes"}),
    ]), WANTED, empty="")  # fmt: skip
