"""Each case of ``bench.py`` in a tiny form: its rows are recorded at their places and shown, and they are right.

Covers: .
"""

import json
import os
import subprocess
import sys
from collections import Counter
from functools import partial

import pytest
import torch
import yaml
from bench import record, slots, stamps
from bench.case import Case, apart, at_once, chosen, put
from bench.cases import accuracy, backward, contact, places, previews, web, winds
from bench.command import CASES
from bench.problems.contacts import crossings, sheet_triangles
from bench.scenes import sheet

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import write_film

from .conftest import HEAD, ROOT, cells, measure, shown

CPU = torch.device("cpu")
CUBE = GridSpec(0.04, (0, 0, 0), (25, 25, 25))
SMALL = {"scene": {"generator": {"class_path": "FlagScene", "init_args": {"spacing": 0.1}}}, "solver": {"dx": 0.2}}


def _small_scene(scene, way, ply=None):
    return SMALL | {"scene": SMALL["scene"] | {"points": "grid" if "grid" in way else "gaussian"}}


TINY = {
    "accuracy": (["--only", "sand element"], {}, {"rows": 1}, ["accuracy.goals", "accuracy.sand_angles"]),
    "area": (["--body", "flag", "--timed", "500"], {}, {"bodies": 1, "timed": 1}, ["area.bodies"]),
    "backward": (["--points", "64", "--steps", "2", "--repeats", "2", "--long", "20"], {},
                 {"rows": 4, "memory": 2, "agreement": 2},
                 ["backward.rows", "backward.memory", "backward.agreement", "backward.goals"]),
    "contact": (["--points", "100", "--repeats", "1", "--speeds", "5"],
                {"collision": partial(contact.collision, points=225, frames=10)},
                {"rows": 4, "collisions": 1}, ["contact.cost", "contact.collisions"]),
    "detail": (["--counts", "20000", "--distances", "2,40", "--widths", "64"], {}, {"detail": 2}, ["detail.rows"]),
    "frames": (["--counts", "20000", "--frames", "2"], {}, {"frames": 2}, ["frames.rows"]),
    "pareto": (["--only", "bar"], {"PROBLEMS": {"bar": ((4,), "cells", 1e-2)}, "CFLS": (0.4,)}, {"rows": 7},
               ["pareto.device"]),
    "points": (["--only", "ficus", "--frames", "3"], {"configuration": _small_scene}, {"rows": 7}, ["points.rows"]),
    "speed": (["--quick", "--only", "substep,sand"], {"CUBE": CUBE}, {"copy": 1, "substep": 4, "sand": 1},
              ["speed.device", "speed.substeps", "speed.batches", "speed.frames"]),
    "substep": ([], {"sheet": lambda _, device: sheet(64, device), "CUBE": CUBE}, {"substep": 6}, ["runs.substep"]),
    "winds": (["--counts", "64", "--formulations", "total"],
              {"BOX": (16, 8, 8), "STEPS": {"cpu": 2}, "ROUNDS": {"cpu": 3}, "CUBE": CUBE,
               "MeshObstacle": partial(winds.MeshObstacle, cells=8)},
              {"box": 1, "rows": 6, "obstacles": 4}, ["winds.rows", "winds.obstacles", "winds.goals"]),
}  # fmt: skip
"""Of each case: arguments, what is made smaller in its module, how many rows it has in each table, and its slots."""


@pytest.fixture
def tiny(bench, tmp_path, monkeypatch):
    """Runs a case in its tiny form, or with other arguments; returns its record."""

    def run(command, *arguments):
        own, changes, _, _ = TINY[command]
        for name, value in changes.items():
            monkeypatch.setattr(sys.modules[CASES[command].rows.__module__], name, value)
        on = ["--device", "cpu"] if CASES[command].device else []
        bench(command, *on, "--results", tmp_path / "results", *(arguments or own))
        return record.read(tmp_path / "results")[f"{command}_cpu"]

    return run


@pytest.mark.parametrize("command", TINY)
def test_a_case_is_measured_recorded_and_shown(command, tiny):
    """A second time rows take the places of the first ones."""
    for _ in range(2 if command == "contact" else 1):
        found = tiny(command)
        places = [place for place, _ in stamps.rows(found)]
        assert Counter(place.split("/")[0] for place in places) == TINY[command][2]
        assert sorted(stamps.stamp_of(found)) == sorted(places)
        assert found["versions"]["torch"]
    for name in TINY[command][3]:
        slot = slots.SLOTS[name]
        assert "failed" not in "\n".join(slot.make([found] if slot.together else found))
    if command == "backward":
        assert [row["pin"] for row in found["rows"]] == ["hinge", None, "nodes", "hinge"]
        assert all(row["ratio"] > 0 for row in found["rows"])
        assert [row["steps"] for row in found["memory"]] == [20, 1]
        assert all(max(row["torch"].values()) < 1e-2 for row in found["agreement"])


# ---- the schema


def test_rows_come_to_their_places():
    result = {"rows": [{"points": 1, "t": 1}, {"points": 2, "t": 2}]}
    put(result, ("rows", {"points": 1}), {"t": 3})
    put(result, ("timed",), {"t": 4})
    put(result, ("gpus", "rows", "1"), {"t": 5})
    assert result == {
        "rows": [{"points": 2, "t": 2}, {"points": 1, "t": 3}],
        "timed": {"t": 4},
        "gpus": {"rows": {"1": {"t": 5}}},
    }


def test_rows_are_saved_one_by_one_and_what_is_stopped_keeps_those_before():
    def rows(options, result):
        yield ("a",), {"t": 1}.copy
        result["done"] = True
        yield ("b",), partial(int, "stop")

    saved = []
    with pytest.raises(ValueError, match="stop"):
        Case("", rows).measure(None, {}, lambda now: saved.append(dict(now)))
    assert saved == [{}, {"a": {"t": 1}}]


def test_measurements_at_once_are_all_made_and_unknown_names_refused():
    found = {place: work() for place, work in at_once(2, (((k,), partial(pow, k, 2)) for k in range(5)))}
    assert found == {(k,): k * k for k in range(5)}
    assert chosen("--rows", ("a", "b"), "b,") == ["b"]
    with pytest.raises(SystemExit, match="--rows takes a, b, not c"):
        chosen("--rows", ("a", "b"), "a,c")


def test_measurements_apart_are_made_in_other_processes_of_one_thread():
    works = {"process": os.getpid, "threads": torch.get_num_threads}
    found = {place: work() for place, work in apart(1, (((name,), work) for name, work in works.items()))}
    assert found["process",] != os.getpid()
    assert found["threads",] == 1


def test_bench_starts_without_the_packages_of_extras():
    """An import at the top of one case would stop all of them."""
    program = (
        "import sys\n"
        "for name in ('msgspec', 'viser', 'websockets', 'zstandard', 'bpy', 'playwright', 'ray', 'newton', 'cv2'):\n"
        "    sys.modules[name] = None\n"
        f"sys.path.insert(0, {str(ROOT / 'tools')!r})\n"
        "import bench.command\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ---- what single cases say


def test_accuracy_replaces_only_what_it_was_asked_for(tiny, tmp_path):
    """Whatever device the others were measured on; without a page beside them nothing else is written."""
    kept = {"problem": "vortex", "parameters": {"variant": "total", "cells": 8}, "result": {"error": 0.5}}
    (tmp_path / "results").mkdir()
    (tmp_path / "results/accuracy_cpu.json").write_text(json.dumps({"device": "another", "rows": [kept]}))
    found = tiny("accuracy")
    assert [row["problem"] for row in found["rows"]] == ["vortex", "sand element"]
    assert found["rows"][1]["result"]["triaxial_deg"] == pytest.approx(30.0, abs=0.1)
    assert [path.name for path in tmp_path.iterdir()] == ["results"]
    angles = cells("accuracy.sand_angles", [found])
    assert [row[1:] for row in angles] == [["34.67", "34.72"], ["30", "30"], ["43.85", "43.85"]]


def test_a_case_that_fails_is_recorded_and_shown(tiny, monkeypatch, tmp_path):
    def broken(**_):
        raise ValueError("no such sand")

    page = tmp_path / "validation.md"
    page.write_text("<!-- begin: accuracy.goals -->\n<!-- end -->\n")
    monkeypatch.setattr(accuracy, "_elements", broken)
    tiny("accuracy")
    assert "failed: sand element" in page.read_text()
    assert "no such sand" in page.read_text()


def test_areas_of_a_skin_and_of_a_capture(tmp_path):
    write_ply(tmp_path / "flag.ply", FlagScene(spacing=0.1).generate())
    bodies = ("--body", "flag", "--body", "two shells, 0.2 m apart")
    found, _ = measure("area", *bodies, "--ply", tmp_path / "flag.ply", "--timed", 500)
    assert found["bodies"]["flag"]["open"] > 0.99
    assert 0.9 < found["bodies"]["two shells, 0.2 m apart"]["open"] < 1.1
    assert found["timed"]["gaussians"] == 500
    assert cells("area.bodies", found)[0] == ["flag", "6,144", "0.96 (as `coverage` finds)", "1.000", "1.000"]
    assert shown("area.capture", found, "flag", "hull") == "1.5"
    assert shown("area.capture", found, "flag", "open") == "1.0"


def test_unknowns_of_the_sheet_move_it():
    """The density is a leaf behind the mass, E behind the stiffness: no gradient vanishes."""
    case = backward.Sheet(64, CPU, "hinge", dtype=torch.float64)
    assert list(case.leaves) == list(backward.SOUGHT)
    for gradient in case.gradients(4):
        assert float(gradient.abs().max()) > 0
    with pytest.raises(RuntimeError):
        torch.autograd.grad(case.loss(case.state.replace(position=case.state.position.detach())), case.leaves["E"])


@pytest.mark.parametrize("case", contact.CASES)
def test_sheets_are_in_contact_as_their_names_say(case):
    solver, state, dt = contact.prepare(200, case, CPU)
    end = solver.rollout(state, dt, 3)
    touching = solver.fused().touching
    assert (touching is None) == (case == "off")
    if case != "off":
        assert (touching.pairs > 0) == ("in contact" in case)
    upper = end.velocity[solver.points.count // 2 :, 2].mean()
    assert (abs(float(upper)) > 1e-6) == ("in contact" in case)
    if case == "all in contact":  # two equal sheets: each gets half the momentum
        torch.testing.assert_close(float(upper), -0.25, rtol=0.02, atol=0)


def test_a_collision_keeps_its_distance():
    row = contact.collision(5.0, CPU, points=225, frames=10)
    assert (row["crossings"], row["closer_than_half"]) == (0, 0.0)


def test_crossings_are_counted():
    """Two squares that cross in the shape of a plus, and apart from each other."""
    flat = torch.tensor([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]])
    upright = torch.tensor([[0.3, 0.2, -0.5], [0.3, 0.2, 0.5], [0.3, 0.9, -0.5], [0.3, 0.9, 0.5]])
    triangles = torch.cat([sheet_triangles(2, 2), sheet_triangles(2, 2, 4)])
    assert crossings(torch.cat([flat, upright]), triangles) > 0
    assert crossings(torch.cat([flat, upright + torch.tensor([2.0, 0, 0])]), triangles) == 0


@pytest.mark.slow(twin="test_a_pile_at_rest_stays_at_rest")
def test_a_pile_rests_for_a_second():
    (row,) = contact.pile(1.0, CPU, layers=2, per_side=2)
    assert row["kinetic"] < 1e-4
    assert row["top"] == pytest.approx(1.0, abs=0.05)  # the ground lies half a thickness below the lower layer
    told = cells("contact.pile", HEAD | {"pile": [row]})[0]
    assert (told[0], told[2:]) == ("1", ["+0.0e+00", "+0.0e+00", "+0.0000", "+0.00", "-"])
    assert shown("contact.pile", {}) == []


def test_other_winds_and_obstacles_are_kept(tiny):
    found = tiny("winds")
    assert [row["wind"] for row in found["rows"]] == list(winds.KINDS)
    assert found["rows"][0]["ratio"] == 1.0
    assert all(row["ratio"] > 0 and row["path"] == "kernels" for row in found["rows"])
    assert found["box"]["cells"] == [16, 8, 8]
    again = tiny("winds", "--counts", "64", "--formulations", "total", "--only", "obstacles")
    assert (again["rows"], again["box"]) == (found["rows"], found["box"])
    assert [row["obstacle"] for row in again["obstacles"]] == list(winds.OBSTACLES)
    assert again["obstacles"] != found["obstacles"]


def test_announced_and_taken_times_stand_side_by_side(tmp_path):
    small = {"scene": {"generator": {"init_args": {"spacing": 0.05}}}, "solver": {"dx": 0.1}}
    small["camera"] = {"init_args": {"width": 64, "height": 36}}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small))
    files = ["--config", str(ROOT / "configs/sim/flag2.yaml"), "--config", str(tmp_path / "small.yaml")]
    found = previews.announced_and_taken("flag2", files, files, "cpu", 3)["run"]
    assert found["frames"] == 3
    assert found["ratio"] == pytest.approx(found["announced_s"] / found["process_s"])
    assert 0 < found["announced_s"] < 60  # of three frames, not of all
    # the preview times two to nine of the first frames, as fast as the machine is: 12 substeps each, 14.7 over nine
    assert found["substeps"] <= found["announced_substeps"] <= 1.25 * found["substeps"]
    assert "nothing.yaml" in previews.announced_and_taken("x", ["--config", "nothing.yaml"], files, "cpu")["failed"]


def test_an_unknown_scene_is_refused_and_none_is_no_work(bench, tmp_path):
    with pytest.raises(SystemExit, match="not bush"):
        bench("previews", "--device", "cpu", "--results", tmp_path, "--scenes", "bush")
    bench("previews", "--device", "cpu", "--results", tmp_path, "--scenes", "")
    assert not list(tmp_path.glob("*.json"))


@pytest.mark.usefixtures("chromium")
def test_size_error_and_speed_of_a_film(tmp_path):
    recorder = {"recorder": {"images": False, "video": False}}
    (tmp_path / "flag.yaml").write_text(yaml.safe_dump(SMALL | recorder))
    Simulation.from_yaml(tmp_path / "flag.yaml").run(tmp_path / "run", 4, progress=False)
    row = web.film_of(tmp_path / "run", 1.0)
    assert (row["frames"], row["gaussians"]) == (4, 96)
    assert 0 < row["error"] < 1e-3
    assert row["pictures_per_s"] > 0
    write_film(tmp_path / "run", tmp_path / "film.html")
    assert row["bytes"] == (tmp_path / "film.html").stat().st_size
    assert cells("web.films", HEAD | {"films": {row["title"]: row}})[0][:2] == ["Flag in the wind", "96"]


@pytest.mark.usefixtures("chromium")
def test_the_first_picture_of_a_place(monkeypatch):
    monkeypatch.setattr(web, "FRAMES", 3)
    monkeypatch.setattr(web, "REPEATS", 1)
    monkeypatch.setattr(web, "WINDOW", (160, 90))
    one, many = web.first_of(20_000, True), web.first_of(20_000, False)
    for row in (one, many):
        assert 0 < row["first_s"] < row["complete_s"]
    assert one["moving"] == many["moving"] > 500
    assert abs(one["bytes"] / many["bytes"] - 1) < 0.05
    record = HEAD | {"films": {}, "first": {"one": one, "many": many}}
    assert [row[0] for row in cells("web.first", record)] == ["one", "many"]


@pytest.mark.usefixtures("chromium", "node")
def test_size_and_speed_of_a_page(monkeypatch):
    monkeypatch.setattr(web, "SPAN", 2)
    monkeypatch.setattr(web, "WINDOW", (160, 90))
    row = web.page_of(["flag", "--scene.generator.init_args.spacing=0.05", "--solver.dx=0.2", "--material.E=9e3"])
    assert row["gaussians"] == 384
    assert min(row["node"], row["hurried"], row["plain"], row["browser"], row["first_s"]) > 0
    assert row["longest_per_s"] < row["substeps_per_s"]
    record = HEAD | {"films": {}, "pages": {"small flag": row}}
    assert cells("web.pages", record)[0][0] == "small flag"
    assert len(cells("web.goals", record)) == 4


@pytest.mark.usefixtures("chromium", "node")
def test_size_and_speed_of_the_page_of_a_made_rider(monkeypatch):
    monkeypatch.setattr(web, "SPAN", 1)
    monkeypatch.setattr(web, "TURNS", 1)
    monkeypatch.setattr(web, "RIDER_DX", 0.1)
    row = web.page_of_rider(3000)
    assert row["gaussians"] == 3000
    assert 300 < row["points"] < 3000
    assert row["browser"] > 0


@pytest.mark.usefixtures("chromium")
def test_time_of_a_substep_in_compute_shaders(monkeypatch):
    monkeypatch.setattr(web, "FEW", 1)
    try:
        row = web.shaded(["flag", "--scene.generator.init_args.spacing=0.05", "--solver.dx=0.2", "--material.E=9e3"])
    except SystemExit:
        pytest.skip("this Chromium offers WebGPU no adapter in software")
    assert row["worker_s"] > 0
    name, points, substeps, *numbers = cells("web.shaders", HEAD | {"films": {}, "shaders": {"small flag": row}})[0]
    assert (name, int(points)) == ("small flag", row["points"])
    speed = 1 / (float(substeps.replace(",", "")) * row["webgpu_s"])
    assert float(numbers[-1]) == pytest.approx(speed, rel=0.05)
    assert float(numbers[1]) == pytest.approx(1e3 * row["webgpu_s"], abs=0.05)


@pytest.mark.usefixtures("chromium")
def test_memory_and_cpu_time_of_a_page():
    row = web.watch(["flag", "--scene.generator.init_args.spacing=0.05", "--solver.dx=0.2", "--material.E=9e3"], 0.02)
    assert row["hidden_cores"] < row["shown_cores"]
    assert min(*row["heap_mb"], *row["resident_mb"]) > 1
    assert cells("web.watched", HEAD | {"films": {}, "watched": {"small flag": row}})[0][0] == "small flag"


def test_a_place_is_previewed_in_a_process_of_its_own():
    """Its memory is that of the preview, without what made the place."""
    row = places.previewed(20_000, "cpu", starters=False)
    assert row["right_first"]
    assert row["plant"] > 500
    assert row["preview_share"] == row["preview_bytes"] / row["file_bytes"]
    assert 1e8 < row["preview_bytes"] < 2e9
    assert "starter_s" not in row
    assert "nothing.ply" in places._tool("preview", ["nothing.ply"])["failed"]
