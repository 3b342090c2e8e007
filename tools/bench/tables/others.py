"""Tables of gallery.md, live.md, many.md, recording.md, web.md and wind.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bench import slots
from bench.cases import gallery
from bench.tables.markdown import stack
from bench.tables.render import GOAL, WANTED, Goal, Row, fill, judged, lines, table, value

LIVE = {("flag", "cpu"): 10.0, ("guitar", "cpu"): 5.0, ("large flag", "cuda"): 25.0}
"""Pictures a second that are wanted on two cores, and on an H200."""
TURBULENCE = {"cuda": 1.15, "cpu": 1.3}
"""Goals: time of a substep in turbulence, per that in uniform gusts."""
BOX = {"cuda": 0.2, "cpu": 2.0}
"""Goals: time to make a box [s]; on a CPU, with two cores."""


def _kind(result: Row) -> str:
    return "cpu" if "CPU" in result["device"] else "cuda"


def _rates(result: Row) -> Iterator[Row]:
    for row in result["rows"]:
        yield row | {"wanted": LIVE.get((row["name"], _kind(result))), "pixels": "x".join(map(str, row["window"]))}


table("live.md", "live.rates", "live_*", _rates, """
    scene = {name} | Gaussians = {gaussians:,} | points = {points:,} | window = {pixels} | picture = {picture} |
    pictures a second = {pictures_per_s:.1f} | wanted = {wanted:g} | KB a picture = {picture_bytes:.0f (KB)} |
    simulated seconds per second = {real_time:.2g} | step [s] = {step_s:.3g} |
    a control shows after [ms] = {latency_ms or '-':.0f}
    """, before="{source}\n\nReceived by one client on the same machine, without a browser.")  # fmt: skip

table("live.md", "live.states", "live_cpu", "rows", """
    scene = {name} | Gaussians = {gaussians:,} | points = {points:,} | grid [m] = {dx_m:.3g} |
    configured [m] = {configured_dx_m:.3g} | states a second = {states_per_s:.1f} |
    simulated seconds per second = {states_real_time:.2f}
    """, before="{source}\n\nReceived by one client on the same machine, which draws nothing.")  # fmt: skip

table("live.md", "drawn.scenes", "drawn_*", "scenes", """
    scene = {key} | Gaussians = {gaussians:,} | nodes = {nodes:,} | scene, once [MB] = {scene_bytes:.1f (MB)} |
    KB a state = {state_bytes:.0f (KB)} | KB a picture = {jpeg_bytes:.0f (KB)} |
    server, a state [ms] = {state_ms:.2g} | server, a picture [ms] = {jpeg_ms:.3g} |
    pictures a second without a graphics card = {pictures_per_s:.1f} | steps a second meanwhile = {steps_per_s:.1f} |
    at pixels = {picture}
    """, before="{source}")  # fmt: skip

table("recording.md", "frames.rows", "frames_*", "frames", """
    `recorder.ply_still` = `{still}` | Gaussians = {gaussians:,} | that move = {moving:,} |
    a frame [MB] = {frame_bytes:.1f (MB)} | a frame [s] = {frame_s:.2f} | once [MB] = {still_bytes:.1f (MB)} |
    once [s] = {still_s:.1f}
    """, before="{source}")  # fmt: skip

table("live.md", "detail.rows", "detail_*", "detail", """
    scene = {scene} | Gaussians = {gaussians:,} | width [pixels] = {width} | distance [sizes] = {distance:g} |
    covered [%] = {covered:.1f (%)} | drawn of all [%] = {kept:.0f (%)} | all [s] = {whole_s:.3f} |
    some [s] = {some_s:.3f} | PSNR [dB] = {psnr_db:.1f} | of a JPEG [dB] = {jpeg_db:.1f}
    """, before="{source}", order=("scene", "gaussians", "width", "distance"))  # fmt: skip

table("web.md", "web.films", "web_*", "films", """
    film = {key} | Gaussians = {gaussians:,} | nodes = {nodes:,} | frames = {frames:,} | file [MB] = {bytes:.1f (MB)} |
    largest error [% of the size] = {error:.4f (%)} | pictures a second = {pictures_per_s:.1f}
    """, before="{source}")  # fmt: skip

table("web.md", "web.first", "web_*", lambda result: result.get("first", {}).values(), """
    parts = {parts} | Gaussians = {gaussians:,} | that move = {moving:,} | frames = {frames} |
    file [MB] = {bytes:.1f (MB)} | first picture [s] = {first_s:.1f} | all has come [s] = {complete_s:.1f}
    """, before="{source}", empty="")  # fmt: skip

PAGES = [
    Goal("{key}: solver in {what}, simulated seconds per second, at least {limit:g}", "{speed:.2f}", "speed >= 1"),
    Goal("{key}: file [MB], at most {limit:g}", "{megabytes:.1f}", "megabytes <= 12"),
    Goal("{key}: first picture [s], at most {limit:g}", "{picture_s:.1f}", "picture_s <= 2"),
]


def _pages(result: Row) -> Iterator[Row]:
    for key, row in result.get("pages", {}).items():
        yield {"key": key, "what": "Node.js", "speed": row["hurried"]}
        size = {"megabytes": row["bytes"] / 1e6, "picture_s": row["first_s"]}
        yield {"key": key, "what": "Chromium", "speed": row["browser"]} | size


def _watched(result: Row) -> Iterator[Row]:
    for key, row in result.get("watched", {}).items():
        early = min(1, len(row["heap_mb"]) - 1)
        memory = {"early": row["resident_mb"][early], "late": row["resident_mb"][-1]}
        yield {"key": key, **row, **memory, "early_heap": row["heap_mb"][early], "late_heap": row["heap_mb"][-1]}


table("web.md", "web.pages", "web_*", "pages", """
    page = {key} | Gaussians = {gaussians:,} | points = {points:,} | grid [m] = {dx_m:.3g} |
    substeps a second = {substeps_per_s:,.0f} | file [MB] = {bytes:.1f (MB)} | first picture [s] = {first_s:.1f} |
    Node.js [x real time] = {node:.2f} | without WebAssembly = {plain:.2f} |
    longest substeps: a second = {longest_per_s:,.0f} | Node.js = {hurried:.2f} | Chromium = {browser:.2f}
    """, before="{source}", empty="")  # fmt: skip


def _shaders(result: Row) -> Iterator[Row]:
    for key, row in result.get("shaders", {}).items():
        both = ("worker", "webgpu")
        speeds = {f"{name}_x": 1 / (row[f"{name}_s"] * row["substeps_per_s"]) for name in both}
        yield {"key": key, **row, **speeds, **{f"{name}_ms": 1e3 * row[f"{name}_s"] for name in both}}


table("web.md", "web.shaders", "web_*", _shaders, """
    page = {key} | points = {points:,} | substeps a second = {substeps_per_s:,.0f} |
    WebAssembly: a substep [ms] = {worker_ms:.2f} | WebGPU in software: a substep [ms] = {webgpu_ms:.1f} |
    WebAssembly [x real time] = {worker_x:.2f} | WebGPU in software [x real time] = {webgpu_x:.3f}
    """, before="{source}", empty="")  # fmt: skip
table("web.md", "web.watched", "web_*", _watched, """
    page = {key} | points = {points:,} | minutes = {minutes:g} | x real time = {real_time:.2f} |
    memory after a minute [MB] = {early:.0f} | at the end [MB] = {late:.0f} |
    of it JavaScript after a minute [MB] = {early_heap:.1f} | JavaScript at the end [MB] = {late_heap:.1f} |
    cores while it is shown = {shown_cores:.2f} | while it is hidden = {hidden_cores:.2f}
    """, before="{source}", empty="")  # fmt: skip
table("web.md", "web.goals", "web_*", judged(PAGES, _pages), GOAL, empty="")

_SHEET, _ORDER = "sheet = `{formulation}`, {particles:,} points", ("formulation", "particles")


def _winds(result: Row) -> list[Row]:
    return [row | {"most": TURBULENCE[_kind(result)]} for row in result.get("rows", [])]


def _boxes(result: Row) -> Iterator[Row]:
    box = result.get("box", {"cells": []})
    for name in ("isotropic", "sheared"):
        if f"{name}_s" in box:
            size = " x ".join(map(str, box["cells"]))
            yield {"size": size, "name": name, "seconds": box[f"{name}_s"], "most": BOX[_kind(result)]}


table("wind.md", "winds.rows", "winds_*", "rows", f"""
    {_SHEET} | wind = {{wind}} | runs in = {{path}} | substep [ms] = {{median_ms:.3g}} |
    per that in uniform gusts = {{ratio:.2f}}
    """, before="{source}", order=_ORDER, empty="")  # fmt: skip
table("wind.md", "winds.obstacles", "winds_*", "obstacles", f"""
    {_SHEET} | obstacle = {{obstacle}} | runs in = {{path}} | substep [ms] = {{median_ms:.3g}} |
    per that without = {{ratio:.2f}}
    """, before="Substeps of a sheet that lies on an obstacle of the solver ([contact.md](contact.md)), without wind: "
    "{source}", order=_ORDER, empty="")  # fmt: skip
WIND_GOALS = [
    Goal("substep in turbulence, `{formulation}`, {particles:,} points", "{ratio:.2f}", "ratio <= most",
         _winds, "wind is 'turbulence'",
         {"wanted": "at most {limit} times uniform gusts"}),
    Goal("box of {size}, {name}", "{seconds:.2f} s", "seconds <= most", _boxes, more={"wanted": "at most {limit} s"}),
]  # fmt: skip
table("wind.md", "winds.goals", "winds_*", judged(WIND_GOALS), WANTED)


def _sweeps(results: list[Row]) -> list[Row]:
    """One row: the first record of each section, and how two GPUs compare with one where both were measured."""
    row: Row = {}
    for name in ("workers", "gpus", "training"):
        row[name] = next((result[name] for result in results if result.get(name)), {})

    def both(part: str, key: str) -> list[Any]:
        found = row[part].get("rows", {})
        return [found[count][key] for count in "12" if key in found.get(count, {})]

    for name, part, key in (("command", "gpus", "wall_s"), ("frames", "gpus", "frames_s"),
                            ("faster", "training", "seconds")):  # fmt: skip
        if len(pair := both(part, key)) == 2:
            row[name] = pair[0] / pair[1]
    if len(pair := both("training", "psnr_db")) == 2:
        row |= {"gain": pair[1] - pair[0], "change": abs(pair[1] - pair[0])}
    if (rates := both("gpus", "per_s")) and "per_s" in row["gpus"].get("sheet", {}):
        row["share"] = rates[0] / row["gpus"]["sheet"]["per_s"]
    if row["workers"]:
        row["tables"] = "equal" if row["workers"]["equal"] else "not equal"
    return [row]


SWEEP_GOALS = [
    Goal("40 small flags on two CPU cores, a worker killed at random five times: complete, and the same table",
         "{workers.disturbed.complete} complete, {workers.disturbed.killed} killed, tables {tables}",
         "tables is 'equal' and workers.disturbed.complete is workers.runs and workers.disturbed.killed is 5",
         always=True),
    Goal("256 flags of 4,096 points on 2 GPUs at least {limit:g} times as fast as on one",
         "{command:.2f} times the whole command, {frames:.2f} times from first to last frame", "command >= 1.9",
         always=True),
    Goal("the same on one GPU at no less than {limit:g %} of the particle rate of one sheet", "{share:.0f %}",
         "share >= 0.9", always=True),
    Goal("the fox at four times its size on 2 GPUs: training at least {limit:g} times as fast", "{faster:.2f} times",
         "faster >= 1.7", always=True),
    Goal("the same PSNR within {limit:g} dB", "{gain:+.2f} dB", "change <= 0.1", always=True),
]  # fmt: skip
table("many.md", "sweeps.goals", "sweeps_*", judged(SWEEP_GOALS, _sweeps), GOAL, together=True)
table("many.md", "sweeps.devices", "sweeps_*", before="{source}", each=True)


def _workers(results: list[Row]) -> list[Row]:
    found = _sweeps(results)[0]["workers"]
    return [found | found[name] | {"key": name} for name in ("undisturbed", "disturbed") if found]


def _gpus(results: list[Row]) -> Iterator[Row]:
    found = _sweeps(results)[0]["gpus"]
    for count, row in found.get("rows", {}).items():
        yield row | {"what": f"{found['flags']} flags, {found['frames']} frames, {count} GPU{'s' * (count != '1')}"}
    if "per_s" in (sheet := found.get("sheet", {})):
        yield sheet | {"what": f"one sheet, {sheet['frames']} frames, 1 GPU", "wall_s": None, "memory_bytes": None}


def _training(results: list[Row]) -> Iterator[Row]:
    found = _sweeps(results)[0]["training"]
    for count, row in found.get("rows", {}).items():
        yield row | {"what": f"{found['images']:,} images, {count} GPU{'s' * (count != '1')}"}


table("many.md", "sweeps.workers", "sweeps_*", _workers, """
    {runs} small flags, {workers} workers = {key} | killed = {killed} | complete = {complete} |
    runs begun = {attempts} | seconds = {seconds:.0f}
    """, together=True, empty="")  # fmt: skip
table("many.md", "sweeps.gpus", "sweeps_*", _gpus, """
    = {what} | points of each = {particles:,} | whole command [s] = {wall_s:.1f} | frames [s] = {frames_s:.1f} |
    10⁶ particle substeps/s = {per_s:,.0f (10⁶)} | memory of a GPU [GiB] = {memory_bytes:.2f (GiB)}
    """, together=True, empty="", before="Square flags of 0.8 m in different winds, without pictures and files, one "
    "group on each GPU. The last row is one flag with as many points as all of them. *Frames* leaves out the start of "
    "the programs:")  # fmt: skip
table("many.md", "sweeps.training", "sweeps_*", _training, """
    the fox, 1080 x 1920 pixels = {what} | steps = {steps} | seconds = {seconds:.1f} | PSNR [dB] = {psnr_db:.2f} |
    Gaussians = {gaussians:,}
    """, together=True, empty="", before="Training with photos enlarged to 1080 x 1920 pixels and the photometric loss "
    "only; PSNR is that of the written splat on photos that were held out:")  # fmt: skip


def _scenes(result: Row) -> Iterator[Row]:
    """The scenes in their order, marked if their configuration has changed since."""
    for name, title in gallery.SCENES.items():
        if (row := result["scenes"].get(name)) is None:
            continue
        title += " \\*" * ("failed" not in row and not gallery.of_today(name, row))
        more = {"title": title, "ok": gallery.whole(row)}
        if "failed" not in row:
            wall = sum(row["wall_s"].get(part, 0.0) for part in ("simulation", "shading", "rendering"))
            more |= {
                "frame_ms": 1e3 * wall / max(row["frames"], 1),
                "each": row["substeps"] / max(row["frames"] - 1, 1),
            }
        yield row | more


_SCENE = """
    scene = {title}[[, preset `{preset}`]] | particles = {particles:,} | formulation = `{formulation}` |
    frames = {frames} | substeps per frame = {each:.0f} | time per frame [ms] = {frame_ms:.1f} |
    whole process [s] = {process_s:.0f} | host memory [GiB] = {peak_memory_bytes.host:.2f (GiB)} |
    device memory [GiB] = {peak_memory_bytes.device:.2f (GiB)} | displacement / size = {displacement_share:.1f %} |
    OK = {ok}
    """
_OLD = "\\* Recorded before a configuration file of this scene changed, or before records noted their files."


@slots.table("gallery.md", "gallery.scenes", "gallery_*")
def scenes(result: Row) -> list[str]:
    """Time, memory and motion of each scene of a record."""
    rows = list(_scenes(result))
    old = ["", _OLD] if any(row["title"].endswith("*") for row in rows) else []
    return [fill("{device}; {stack}; seed {seed}.", result | {"stack": stack(result)}), "", *lines(rows, _SCENE), *old]


value("gallery.least", "gallery_*", "{limit:g %}", lambda _: {"limit": gallery.LEAST}, together=True)
value("gallery.most", "gallery_*", "{limit:g %}", lambda _: {"limit": gallery.MOST}, together=True)
