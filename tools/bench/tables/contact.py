"""Tables of contact.md: ``bench.py contact``, and ``bench.py folds``, a flag that folds onto itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bench.cases.contact import CASES
from bench.cases.folds import REFERENCES, ROWS
from bench.tables.plots import save_figure, subplots
from bench.tables.render import GOAL, Goal, Row, fill, judged, table

PAGE = "contact.md"


def _costs(result: Row) -> Iterator[Row]:
    """The cases of each size that has all of them, by their names."""
    for points in sorted({row["wanted"] for row in result["rows"]}):
        of = {row["case"]: row for row in result["rows"] if row["wanted"] == points}
        if set(of) == set(CASES):
            off, most = of["off"], of[CASES[-1]]
            ratios = {case: of[case]["median_ms"] / off["median_ms"] for case in CASES}
            yield {"points": off["points"], "of": of, "pairs": most["pairs"], "ratio": ratios}


table(PAGE, "contact.cost", "contact_*", _costs, f"""
    points = {{points:,}} | {" | ".join(f"{case} [ms] = {{of.{case}.median_ms:.3g}}" for case in CASES)} |
    pairs listed for all = {{pairs:,}} | a fifth / off = {{ratio.{CASES[-2]}:.2f}} |
    all / off = {{ratio.{CASES[-1]}:.2f}}
    """, before="{source}")  # fmt: skip

table(PAGE, "contact.collisions", "contact_*", "collisions", """
    speed [m/s] = {speed_m_s:g} | pairs of all frames = {pairs:,} | closest = {closest:.2f} thicknesses |
    closer than half = {closer_than_half:.3f %} | crossings = {crossings} | momentum lost = {momentum_change:.1e}
    """, before="{source}")  # fmt: skip


def _pile(result: Row) -> Iterator[Row]:
    """The first second, and every tenth, with the changes since the first."""
    rows = result.get("pile", [])
    for row in [*rows[:1], *(row for row in rows if round(row["time"]) % 10 == 0)]:
        changes = {name: row[name] - rows[0][name] for name in ("elastic", "potential", "top", "slid")}
        yield row | changes


table(PAGE, "contact.pile", "contact_cuda", _pile, """
    time [s] = {time:.0f} | motion = {kinetic:.1e} | bending = {elastic:+.1e} | height = {potential:+.1e} |
    top layer [thicknesses] = {top:+.4f} | slid [mm] = {slid:+.2f (mm)} | iterations = {rounds or '-':.1f}
    """, before="{source}", empty="")  # fmt: skip


table(PAGE, "contact.effort", "contact_*", "effort", """
    iterations, at most = {iterations} | closest at 2 m/s = {collisions.2.closest:.2f} |
    closest at 50 m/s = {collisions.50.closest:.2f} | crossings at 50 m/s = {collisions.50.crossings} |
    closest in the pile = {pile.closest:.2f} | top layer = {pile.top:.2f} |
    speed in the pile [mm/s] = {pile.fastest:.2f (mm)} | error of sliding = {sliding_error:.2f %} |
    a fifth / off = {ratio.a fifth in contact:.2f} |
    all / off = {ratio.all in contact:.2f}
    """, before="{source}", empty="")  # fmt: skip


def plot(results: list[Row], pictures: Path) -> None:
    """Draw ``contact_effort.png``: what iterations do and cost."""
    known = [result for result in results if result.get("effort")]
    if not known:
        return
    figure, (left, right) = subplots(1, 2, figsize=(9, 3.4))
    rows = known[0]["effort"]
    most = [row["iterations"] for row in rows]
    for name, found in {
        "sheets that meet at 2 m/s": [row["collisions"]["2"]["closest"] for row in rows],
        "sheets that meet at 50 m/s": [row["collisions"]["50"]["closest"] for row in rows],
        "pile of eight layers": [row["pile"]["closest"] for row in rows],
    }.items():
        left.semilogx(most, found, "o-", label=name)
    left.set_ylabel("closest [thicknesses]")
    left.set_ylim(0, 1.05)
    left.legend(fontsize=8)
    for result, line in zip(known, ("o-", "s--"), strict=False):
        for case in CASES[2:]:
            found = [row["ratio"][case] for row in result["effort"]]
            right.semilogx(
                [row["iterations"] for row in result["effort"]], found, line, label=f"{case}, {result['device']}"
            )
    right.set_ylabel("substep / substep without contact")
    right.set_ylim(bottom=0)
    right.legend(fontsize=8)
    for axis in (left, right):
        axis.set_xlabel("iterations in a substep, at most")
        axis.set_xticks(most, [str(count) for count in most])
        axis.minorticks_off()
    save_figure(figure, pictures / "contact_effort.png")


def _doubt(known: Row) -> float | None:
    """The largest distance of a reference from itself, solved otherwise."""
    return max((row["chamfer"] for row in known.get("uncertainty", {}).values()), default=None)


def _folds(result: Row) -> Iterator[Row]:
    """What is how far from each reference: our rows, the references, and each solved otherwise."""
    known = result["references"]
    names = [name for name in REFERENCES if name in known]

    def line(title: str, near: Row, crossings: object) -> Iterator[Row]:
        row = {"title": title, "crossings": crossings}
        yield from (row | {"to": REFERENCES[name], "near": near.get(name)} for name in names)

    for name, fold in ROWS.items():
        if row := result.get("rows", {}).get(name):
            broken = "failed" in row or row["status"] != "complete"
            near = {other: "failed" if broken else row["to"].get(other, {}).get("chamfer_share") for other in names}
            yield from line(fold.title(), near, None if broken or not row["crossings"] else sum(row["crossings"]))
    for name in names:
        near = {
            other: result["apart"].get(f"{name} {other}", result["apart"].get(f"{other} {name}")) for other in names
        }
        count = known[name]["crossings"]
        yield from line(REFERENCES[name], near | {name: ""}, sum(count) if count else None)
    yield from line("the reference itself, solved otherwise", {name: _doubt(known[name]) for name in names}, "")


table(PAGE, "folds.rows", "folds_*", _folds, " = {title} | *{to} = {near:.2f %} | crossings = {crossings}",
      before="{source}")  # fmt: skip


def _references(result: Row) -> Iterator[Row]:
    for name, row in result["references"].items():
        ways = [one | {"key": key} for key, one in row.get("uncertainty", {}).items()]
        told = "; ".join(fill("{key} ({cells} cells, {quality} steps) {chamfer:.2f %}", way) for way in ways)
        yield row | {"title": REFERENCES[name], "ways": told}


table(PAGE, "folds.references", "folds_*", _references, """
    reference = {title} | cells along the flag = {cells} | steps per frame = {quality} | frames = {frames} |
    solved otherwise = {ways}
    """)  # fmt: skip


def _near(result: Row) -> Iterator[Row]:
    """Each row beside the reference with the same contact; the limit is two per cent above what that is in doubt."""
    for name, fold in ROWS.items():
        other = "blender_contact" if fold.contact else "blender"
        doubt = _doubt(result["references"].get(other, {}))
        near = result.get("rows", {}).get(name, {}).get("to", {}).get(other, {}).get("chamfer_share")
        if near is not None and doubt is not None:
            told = {"title": fold.title(), "other": REFERENCES[other], "near": near, "doubt": doubt}
            yield told | {"above": 0.02, "most": doubt + 0.02}


FOLD_GOALS = [
    Goal("{title}: within {above:g %} above the uncertainty of {other}", "{near:.2f %}, {doubt:.2f %} + {above:g %}",
         "near <= most", _near),
]  # fmt: skip
table(PAGE, "folds.goals", "folds_*", judged(FOLD_GOALS), GOAL, empty="")
