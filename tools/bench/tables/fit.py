"""Tables of fit.md: ``bench.py fit``, what was found from videos, and ``bench.py soft``, the same of a soft body."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import partial

from bench.cases.fit_films import GOALS, INDEPENDENT, counted, covered, misses
from bench.tables.render import Row, fill, table, value
from gaussian_swaying.fitting.report import ASTRAY
from gaussian_swaying.fitting.scale import SCALE

PAGE = "fit.md"

OWN = (0.01, 1.0, 0.01)
TWO, ONE = (0.05, 3.0, 0.10), (0.10, 6.0, 0.20)
"""Goals: error of the speed, angle between the winds [degrees], error of E."""
ABLATIONS = ("tracks alone", "pixels alone", "without patches")
"""Rows that have no goal."""
LOST = 100.0
"""Distance [pixels] above which a simulation with the true values does not show the same motion at all."""
SHARP = 28.0
"""Least PSNR of the predicted frames [dB], unless the splat at rest has less."""

_BLANK = dict.fromkeys(("direction_error_deg", "material.E_error", "psnr_predicted_db", "psnr_rest_db", "seconds",
                        "processor_s", "sharp"), "")  # fmt: skip
"""What a row need not have."""
_FOUND = """ = {name} | speed = {speed_error:+.2f %} | direction = {direction_error_deg:.2f °} |
    E = {material.E_error:+.2f %} | predicted frames = {psnr_predicted_db:.1f dB} | time = {seconds:.0f s}"""


def _rows(result: Row, part: str) -> Iterator[Row]:
    """What each fit found, whether it reaches the goals of its kind, and whether its frames are sharp."""
    for name, row in result.get(part, {}).items():
        lost = row.get("psnr_rest_db", 0.0) - row.get("psnr_fitted_db", math.inf) > ASTRAY
        named = name + " (not settled)" * bool(row.get("not_settled")) + " (not followed)" * lost
        base = [fill("{until_s:.3g} s", row)] if "until_s" in row else []
        base += [f"{row['cells']} cells"] if row.get("cells") else []
        base += [", ".join(f"`{key}` {value}" for key, value in row.get("known", {}).items())]
        told = {"key": name, "name": named, "base": "; ".join(filter(None, base))}
        if "refused" in row:
            more = {"speed_error": "refused", "reached": False, "sharp": ""}
        else:
            limits = OWN if part == "own" else ONE if "one camera" in name else TWO
            errors = row["speed_error"], row["direction_error_deg"], row.get("material.E_error", 0.0)
            reached = all(abs(error) <= limit for error, limit in zip(errors, limits, strict=True))
            more = {"reached": reached, "sharp": row["psnr_predicted_db"] >= min(SHARP, row.get("psnr_rest_db", SHARP))}
        yield _BLANK | row | told | more | ({"reached": ""} if name.split(", ")[-1] in ABLATIONS else {})


def _data(result: Row) -> str:
    """The source, and the data of the first fit that was not refused."""
    one = next(row for row in result["own"].values() if "points" in row)
    told = "{points:,} points, videos of {size.0} x {size.1}, {until_s:.3g} s fitted."
    return "{source}\n\n" + fill(told, one | {"size": dict(zip("01", one["size"], strict=True))})


def _counted(result: Row) -> Row:
    """How many fits of Blender's cloth have goals, reach them, and predict frames as sharp as wanted."""
    rows = [row for row in _rows(result, "blender") if row["reached"] != ""]
    return {"all": len(rows)} | {name: sum(row[name] is True for row in rows) for name in ("reached", "sharp")}


table(PAGE, "fit.own", "fit_*", partial(_rows, part="own"), f"{_FOUND} | within 1 % and 1 degree = {{reached}}",
      before=_data, each=True, empty="")  # fmt: skip
table(PAGE, "fit.blender", "fit_*", partial(_rows, part="blender"), f"""
    {_FOUND} | splat at rest = {{psnr_rest_db:.1f dB}} | 28 dB, or as at rest = {{sharp}} |
    fitted; mesh; changes of scene.yaml = {{base}} | goal reached = {{reached}}
    """, before="{source}", order=["key"], each=True, empty="")  # fmt: skip
value("fit.within", "fit_*", "{reached:g} of {all}", _counted)
value("fit.sharp", "fit_*", "{sharp:g} of {all}", _counted)


def _biases(result: Row) -> Iterator[Row]:
    """How far faults of the model alone move the values; options are named by their last word."""
    for name, row in result.get("bias", {}).items():
        case, *options = name.split(", ")
        short = (f"`{option.split('.', option.split(' ')[0].count('.'))[-1]}`" for option in options)
        blank = {"speed_error": "", "azimuth_error_deg": "", "material.E_error": ""}
        lost = {"told": "the simulation diverged"} | blank if row["rms_px"] > LOST else {}
        yield {"told": fill("{rms_px:.2f} pixels", row)} | row | lost | {"name": ", ".join([case, *short])}


table(PAGE, "fit.bias", "fit_*", _biases, """
    case and grid = {name} | distance = {told} | speed = {speed_error:+.2f %} |
    azimuth = {azimuth_error_deg:+.2f °} | E = {material.E_error:+.2f %} | points = {points:,}
    """, before="{source}", each=True, empty="")  # fmt: skip


def _unfitted(result: Row) -> Iterator[Row]:
    """What a splat predicts that is not fitted: moved as the reference, or simulated with the true values."""
    for name, row in sorted(result.get("reference", {}).items()):
        case, motion = name.split(", ", 1)
        yield row | {"case": case, "motion": motion.removeprefix("uncertainty/")}


table(PAGE, "fit.reference", "fit_*", _unfitted, """
    predicted frames = {case} | *{motion} = {psnr_predicted_db:.1f dB}
    """, before="{source}", each=True, empty="")  # fmt: skip


def _motions(result: Row) -> Iterator[Row]:
    """Motions at the true values beside Newton's, and Newton's on other meshes."""
    for part, title in (("motion", "ours, {key}; {points:,} points"), ("reference", "Newton, {key}")):
        for name, row in result.get(part, {}).items():
            changes = {key: row[key] - 1 for key in ("swing", "deflection")}
            yield row | changes | {"name": fill(title, row | {"key": name})}


table(PAGE, "fit.soft_motion", "soft_*", _motions, """
    = {name} | mean distance = {mean_m:.2f mm} | largest distance = {largest_m:.1f mm} |
    first swing = {swing:+.1f %} | deflection later = {deflection:+.1f %}
    """, before="{source}", each=True, empty="")  # fmt: skip
table(PAGE, "fit.soft", "soft_*", partial(_rows, part="fits"), f"""
    {_FOUND} | of the processor = {{processor_s:.0f s}} | splat at rest = {{psnr_rest_db:.1f dB}} |
    fitted; changes of scene.yaml = {{base}}
    """, before="{source}", each=True, empty="")  # fmt: skip


def _films(result: Row, part: str) -> Iterator[Row]:
    """Fits of small films: how far they miss, and what they say of themselves."""
    for name, row in result.get(part, {}).items():
        off = {"speed": "", "azimuth": "", "E": ""}
        if "errors" in row:
            off = {key: row["errors"][own] for key, own in zip(off, GOALS, strict=True)}
        missed = "yes" if misses(row, 2) else ""
        start = row.get("further", {}).get("film.start", ("",))[0]
        scale = dict(zip(("scale", "scale_error"), row.get("further", {}).get(SCALE, ("", "")), strict=True))
        blank = {"name": name, "missed": missed, "start": start, "gain_at_the_end": "", "true_gain": ""}
        yield blank | scale | row | off


_OFF = "speed = {speed:+.1f %} | azimuth = {azimuth:+.1f °} | E = {E:+.1f %}"
table(
    PAGE,
    "fit.starts",
    "fit_films_cpu",
    partial(_films, part="starts"),
    f"film = {{name}} | {_OFF} | start = {{start:.2f s}} | verdict = {{verdict}}",
    empty="",
    before="{source}",
)
_SETS = {"": f"0 to {INDEPENDENT - 1}", "independent_": f"from {INDEPENDENT}"}


def _verdicts(result: Row) -> Iterator[Row]:
    """What fits from bad starts say of themselves: numbers of films of each thing."""
    for section, told in _SETS.items():
        sorted_in: dict[str, list[Row]] = {}
        for name, row in result.get(f"{section}verdicts", {}).items():
            sorted_in.setdefault(re.sub(" [0-9]+", "", name), []).append(row)
        for kind, rows in sorted_in.items():
            yield {"numbers": told, "kind": kind} | counted(rows)


def _missed(result: Row) -> Iterator[Row]:
    """The fits from bad starts that miss the goals, or are not called good."""
    for section in _SETS:
        for row in _films(result, f"{section}verdicts"):
            if row["verdict"] != "good" or misses(row):
                yield row


table(PAGE, "fit.verdicts", "fit_films_cpu", _verdicts, """
    films = {kind} | numbers = {numbers} | fitted = {films} | within the goals = {within} | good = {good} |
    doubtful = {doubtful} | failed = {failed} | good, but more than twice the goals off = {wrong} |
    processor, median = {processor_s:.0f s}
    """, empty="", before="{source}")  # fmt: skip
table(PAGE, "fit.missed", "fit_films_cpu", _missed, f"""
    film = {{name}} | {_OFF} | verdict = {{verdict}} | more than twice the goals off = {{missed}}
    """, empty="", before="{source}")  # fmt: skip
table(
    PAGE,
    "fit.winds",
    "fit_films_cpu",
    partial(_films, part="winds"),
    f"""
    film = {{name}} | {_OFF} | speed after 1 s per that at first = {{gain_at_the_end:.2f}} | true = {{true_gain:.2f}} |
    verdict = {{verdict}}""",
    empty="",
    before="{source}",
)
table(PAGE, "fit.scales", "fit_films_cpu", partial(_films, part="scales"), f"""
    film = {{name}} | {_OFF} | length found, of 1 m = {{scale:.3f m}} | standard error = {{scale_error:.3f m}} |
    verdict = {{verdict}}
    """, empty="", before="{source}")  # fmt: skip


def _gusts(result: Row) -> Iterator[Row]:
    """Mean, intensity and time scale of winds with gusts, as intervals."""
    for name, row in result.get("gusts", {}).items():
        known = row.get("gusts") or {}
        told = {key: "{:.2g} ({:.2g} to {:.2g})".format(*known[key]) if known else "" for key in _SPECTRUM}
        blank = {"true_mean": ""}
        yield blank | row | told | {"name": name, "told": "yes" if known.get("told") else "no"}


_SPECTRUM = ("mean", "intensity", "time_scale")
table(PAGE, "fit.gusts", "fit_films_cpu", _gusts, """
    film = {name} | mean [m/s] = {mean} | of the film [m/s] = {true_mean:.2f} | intensity = {intensity} |
    time scale [s] = {time_scale} | time scale is told = {told} | verdict = {verdict}
    """, empty="", before="{source}")  # fmt: skip
table(
    PAGE,
    "hand_films.rows",
    "hand_films_cpu",
    partial(_films, part="rows"),
    f"""
    film = {{name}} | {_OFF} | start = {{start:.2f s}} | verdict = {{verdict}} |
    more than twice the goals off = {{missed}} | processor = {{processor_s:.0f s}} |
    memory [GiB] = {{peak_bytes:.2f (GiB)}}""",
    empty="",
    before="{source}",
)
table(PAGE, "fit.coverage", "fit_films_cpu", lambda result: [
    covered(list(result[f"{section}coverage"].values())) | {"numbers": told}
    for section, told in _SETS.items() if result.get(f"{section}coverage")], """
    numbers = {numbers} | films = {films:.0f} | speed = {wind.speed:.0f %} | azimuth = {wind.azimuth:.0f %} |
    E = {material.E:.0f %} | all = {all:.0f %}""", empty="", before="{source}")  # fmt: skip


table("fit.md", "registration.rows", "registration_cpu", lambda result: [
    row | {"view": row["field of view"]} for row in result.get("rows", [])], """
    object = {object} | field of view = {view} | cameras within 0.5 degrees and 1 % = {right} of {poses} |
    angle, median [degrees] = {degrees:.2f} | largest = {most_degrees:.2f} |
    place, median [% of the distance] = {distance:.2f (%)} | largest = {most_distance:.2f (%)} |
    time [s] = {seconds:.1f}
    """, empty="", before="Cameras of pictures in another light, found from no pose:\n\n{source}")  # fmt: skip
table("fit.md", "film_fit.rows", "film_fit_*", "rows", """
    film of = {film} | whole command [s] = {wall_s:.0f} | of the processor [s] = {processor_s:.0f} |
    memory [GiB] = {peak_bytes:.2f (GiB)} | speed = {speed_error:+.1f %} | azimuth = {azimuth_error_deg:.1f}° |
    E = {E_error:+.1f %} | verdict = {verdict}
    """, empty="", before="A flag on its pole, 540 x 960; 1.5 s of motion are fitted:\n\n{source}")  # fmt: skip
table("fit.md", "handheld.rows", "handheld_cpu", lambda result: [
    row | {"name": name} for name, row in result.get("rows", {}).items()], """
    film = {name} | camera, median [degrees] = {degrees:.3f} | largest = {most_degrees:.2f} |
    place, median [% of the distance] = {distance:.2f (%)} | largest = {most_distance:.2f (%)} |
    flag in the picture [pixels] = {px:.2f} | gain, largest = {gain:.1f %} |
    speed = {speed_error:+.2f %} | direction = {direction_error_deg:.2f °} | E = {material.E_error:+.1f %} |
    verdict = {verdict} | time of the processor [s] = {processor_s:.0f}
    """, empty="", before=(
    "Errors of cameras, gains and fits of a flag before walls: 480 x 270, H.264 at crf 28, 1.5 s, of which half is "
    "fitted; 1 degree of shake (root mean square), and a brightness that falls by 15 % (red) to 35 % (blue). "
    "The film is drawn from the splat, but for walls that are real, which rays photograph:"
    "\n\n{source}"))  # fmt: skip
