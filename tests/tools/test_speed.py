"""``bench.py speed`` measures all it should, keeps what it has, and its page and goals say what was recorded."""

import json

import pytest
import torch
from bench import scenes
from bench.cases import speed

from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import GridSpec

from .conftest import HEAD, cells, shown

SPREAD = {"median_ms", "quartile_low_ms", "quartile_high_ms", "repeats"}
ROLLOUT = "formulation asked particles grid_nodes nodes substeps path graph_ms bytes bytes_per_s share share_graph"
BATCH = "formulation gusts scenes particles substeps together apart large together_per_s apart_per_s large_per_s ratio"
FRAME = "dx_m main simulation_ms shading_ms rendering_ms particles width height points substeps substep_ms renderer"
KEYS = {
    "substep": SPREAD | {*ROLLOUT.split(), "memory_bytes", "error", "torch"},
    "batch": {*BATCH.split(), "share", "difference"},
    "cube": SPREAD | {"asked", "turning", "walls", "particles", "substeps", "grid_nodes"},
    "frame": SPREAD | {*FRAME.split(), "memory_bytes", "build_memory_bytes"},
}
KEYS["sand"] = KEYS["substep"]


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """A million nodes take longer than all the rest."""
    monkeypatch.setattr(speed, "CUBE", GridSpec(0.04, (0, 0, 0), (25, 25, 25)))


def _speed(bench, results, *arguments):
    bench("speed", "--device", "cpu", "--quick", "--results", results, *arguments)
    return json.loads((results / "speed_cpu.json").read_text())


@pytest.mark.slow(twin="test_only_keeps_the_other_sections")
def test_everything_is_measured_and_shown(bench, tmp_path):
    results = tmp_path / "docs/results"
    found = _speed(bench, results)
    assert found["device"].endswith("threads")
    assert found["versions"]["torch"]
    assert (found["seed"], found["kind"], found["quick"], found["dt_s"]) == (0, "cpu", True, 1e-4)
    assert found["partial"] is False
    assert found["copy"]["bytes_per_s"] > 0
    for section, keys in KEYS.items():
        assert found[section]
        assert all(set(row) == keys for row in found[section])
    assert [(r["formulation"], r["asked"]) for r in found["substep"]] == [
        (name, count) for count in (64, 400) for name in ("total", "updated")
    ]
    for row in found["substep"] + found["sand"]:
        assert 0 < row["quartile_low_ms"] <= row["median_ms"] <= row["quartile_high_ms"]
        assert row["bytes_per_s"] == pytest.approx(1e3 * row["bytes"] / row["median_ms"])
        assert row["share"] == pytest.approx(row["bytes_per_s"] / found["copy"]["bytes_per_s"])
        assert (row["error"] is None) == (row["particles"] == 400)
        if row["error"]:
            assert max(row["error"].values()) < 2e-3
    for row in found["batch"]:
        assert row["ratio"] == pytest.approx(row["apart"]["median_ms"] / row["together"]["median_ms"])
        assert row["difference"] < 1e-5
    (frame,) = found["frame"]
    assert (frame["particles"], frame["width"], frame["height"], frame["main"]) == (1536, 64, 36, True)

    parts = {name: shown(f"speed.{name}", found) for name in ("device", "substeps", "batches", "frames")}
    text = "\n".join(line for lines in parts.values() for line in lines)
    assert text.count("| `total`, sheet in wind, ") == 2
    assert "| `updated`, block of sand, 64 particles, 4 substeps |" in text
    assert "| 2 of 64 particles, `updated`, gusts, 4 substeps |" in text
    assert "| dx = 0.1 m, 1,536 Gaussians, 64x36 |" in text
    assert "Recorded with `--quick`" in text
    assert "failed" not in text
    bench("pages", "--results", results)
    assert (tmp_path / "docs/pictures/speed_cpu.png").stat().st_size > 10_000


def test_a_run_that_is_killed_keeps_what_it_has(bench, monkeypatch, tmp_path):
    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(speed, "bench_frame", killed)
    with pytest.raises(KeyboardInterrupt):
        _speed(bench, tmp_path / "d/r", "--only", "sand,frame")
    found = json.loads((tmp_path / "d/r/speed_cpu.json").read_text())
    assert found["partial"] is True
    assert len(found["sand"]) == 1
    assert found["frame"] == []
    assert "The run was stopped early: the tables below are incomplete." in shown("speed.device", found)


def test_a_case_without_memory_is_recorded_and_the_others_are_measured(bench, monkeypatch, tmp_path):
    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(speed, "bench_rollout", full)
    found = _speed(bench, tmp_path / "d/r", "--only", "sand,batch")
    assert found["sand"] == [{"formulation": "updated", "asked": 64, "failed": "out of memory"}]
    assert all("ratio" in row for row in found["batch"])
    assert cells("speed.substeps", found)[0][:2] == ["`updated`, block of sand, 64 particles", "failed: out of memory"]


def test_an_error_that_cannot_be_measured_does_not_cost_the_time(bench, monkeypatch, tmp_path):
    def full(*_):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 bytes")

    monkeypatch.setattr(speed, "error_of", full)
    (row,) = _speed(bench, tmp_path / "d/r", "--only", "sand")["sand"]
    assert row["error"] == {"failed": "out of memory"}
    assert row["median_ms"] > 0


def test_only_keeps_the_other_sections(bench, tmp_path):
    results = tmp_path / "d/r"
    first = _speed(bench, results, "--only", "substep", "--counts", "36")
    assert [row["particles"] for row in first["substep"]] == [36, 36]
    both = _speed(bench, results, "--only", "sand")
    assert both["substep"] == first["substep"]
    assert len(both["sand"]) == 1
    with pytest.raises(SystemExit, match="not sandd"):
        _speed(bench, results, "--only", "sandd")


def test_the_fewest_bytes():
    """Ten particles and four nodes, by hand: four bytes times the numbers that go in and out."""
    count = scenes.fewest_bytes
    # rest position 3, volume, mu, lambda; of a node u and v in and out, and its mass
    assert count("total", 10, 4) == 4 * (10 * (3 + 3) + 4 * (6 + 6 + 1))
    assert count("total", 10, 4, wind=True) - count("total", 10, 4) == 4 * 10 * (3 + 1)
    # x and F in and out, mass, volume, mu, lambda; of a node mass and momentum, and velocity, in and out
    assert count("updated", 10, 4) == 4 * (10 * (3 + 9 + 3 + 9 + 4) + 4 * (8 + 6))
    assert count("updated", 10, 4, plastic=True) - count("updated", 10, 4) == 4 * 10 * (9 + 9)
    assert count("updated", 1000, 0, wind=True) == 128_000


def test_nodes_in_reach():
    count = scenes.nodes_in_reach
    position = torch.tensor([[0.5, 0.5, 0.5], [0.51, 0.49, 0.52], [0.61, 0.5, 0.5], [0.91, 0.5, 0.5]])
    assert count(position[:1], 0.1) == 27
    assert count(position[:2], 0.1) == 27  # the same cell
    assert count(position[:3], 0.1) == 36  # and the next
    assert count(position, 0.1) == 63  # those from 4 to 7 along x, and from 8 to 10


def test_the_error_is_that_of_the_end():
    """One hundredth of the largest displacement beside the truth is an error of one hundredth."""
    with torch.inference_mode():
        points = scenes.sheet(64, torch.device("cpu"))
        load = scenes.wind_load(points, scenes.wind(0, True, torch.device("cpu")))
        solver = MPMSolver(dx=0.05)
        start = solver.init_state(points, scenes.waves(points.position))
        end = solver.rollout(start, 1e-4, 32, load)
        assert max(speed.error_of(end, solver, start, 32, load).values()) < 1e-4
        moved = (end.position - start.position).abs().amax()
        off = end.replace(position=end.position + 0.01 * moved, velocity=1.02 * end.velocity)
        error = speed.error_of(off, solver, start, 32, load)
    assert error["position"] == pytest.approx(0.01, rel=0.01)
    assert error["velocity"] == pytest.approx(0.02, rel=0.01)


def _recorded(factor):
    """A run on a GPU that needs so many times what the goals ask for."""
    wanted = {("total", 10**5): 0.06, ("total", 10**6): 0.25, ("updated", 10**5): 0.09, ("updated", 10**6): 0.34}
    wanted |= {(name, 10**7): factor * 11 * wanted[name, 10**6] for name in ("total", "updated")}
    rows = [{"formulation": name, "asked": asked, "median_ms": factor * ms} for (name, asked), ms in wanted.items()]
    frame = {"main": True, "median_ms": factor * 5.0, "memory_bytes": int(factor * 0.3 * 2**30)}
    small = {"small": True, "median_ms": factor * 2.0}
    cube = [{"asked": 1_000_000, "turning": False, "walls": walls, "median_ms": factor * ms}
            for walls, ms in ((False, 0.32), (True, 0.35))]  # fmt: skip
    rates = {"ratio": 20 / factor, "share": 0.9 / factor}
    batch = [{"formulation": f, "gusts": g} | rates for f in ("total", "updated") for g in (False, True)]
    sand = [{"asked": 1_000_000, "median_ms": 0.6 * factor}]
    large = {"median_ms": factor * 8.0, "substep_ms": factor * 0.03}
    found = {"kind": "cuda", "substep": rows, "sand": sand, "batch": batch, "frame": [frame, small], "cube": cube}
    return found | {"large": [large], "device": "NVIDIA H200", "copy": {}}


@pytest.mark.parametrize(
    ("factor", "reached", "stretched"), [(0.4, "yes", "yes"), (0.99, "yes", "no"), (2, "no", "no")]
)
def test_goals_are_reached_or_not(factor, reached, stretched):
    found = cells("goals.table", [_recorded(factor)])
    assert len(found) == 22
    assert {row[2] for row in found} == {reached}
    assert {row[4] for row in found} - {"-"} == {stretched}
    assert sum(row[3] == "-" for row in found) == 4


def test_goals_of_what_is_missing_or_failed():
    about = HEAD | {"kind": "cuda", "device": "NVIDIA H200", "copy": {}}
    assert {tuple(row[1:3]) for row in cells("goals.table", [about])} == {("-", "-")}
    failed = _recorded(0.5)
    for section in ("substep", "sand", "cube", "batch", "frame", "large"):
        failed[section] = [{k: v for k, v in row.items() if k in ("formulation", "asked", "gusts", "turning", "walls",
                           "main", "small")} | {"failed": "out of memory"} for row in failed[section]]  # fmt: skip
    assert {tuple(row[1:3]) for row in cells("goals.table", [failed])} == {("out of memory", "no")}
    assert cells("goals.table", [about | {"kind": "cpu", "device": "a CPU"}]) == []


def test_goals_of_the_other_runs():
    """The substep on a CPU, and the captured object on a GPU and on a CPU."""

    def goals(device, **result):
        return {name: told for name, *told in cells("goals.table", [{"device": device} | result])}

    slow = goals("a CPU", substep=[{"particles": 19_881, "formulation": "updated", "median_ms": 41.0}])
    assert list(slow.values()) == [["41.0 ms (`updated`)", "no", "-", "-"]]
    run = {"name": "guitar, 1920x1080", "frames": 250, "peak_memory_bytes": {"device": 10**8}, "without_files_s": 1.2}
    run |= {"lost_particles": 0, "stretch_min": 0.9, "stretch_max": 1.1, "process_wall_s": 7.0}
    found = goals("NVIDIA H200", runs=[run])
    whole = "captured object over 250 frames: no particle lost, singular values of F within [0.5, 2]"
    assert found.pop(whole) == ["[0.90, 1.10], 0 lost (GPU)", "yes", "-", "-"]
    assert sorted(found.values()) == [["1.20 s, 0.09 GiB", "yes", "1 s", "no"], ["7.0 s", "yes", "6 s", "no"]]
    found = goals("a CPU", runs=[run | {"name": "guitar, 960x540", "process_wall_s": 185.0}])
    assert found.pop(whole)[1] == "yes"
    assert list(found.values()) == [["185 s", "no", "20 s", "no"]]


def test_goals_of_rollouts_are_not_those_of_a_single_substep():
    row = {"particles": 19_881, "formulation": "total", "median_ms": 1.0}
    assert cells("goals.table", [{"device": "a CPU", "kind": "cpu", "copy": {}, "substep": [row]}]) == []


def test_goals_of_a_laptop():
    """Of the sheet of 20,000 particles, in each formulation."""
    rows = [{"formulation": name, "asked": 20_000, "median_ms": ms} for name, ms in (("total", 1.2), ("updated", 3.4))]
    rows.append({"formulation": "total", "asked": 100_000, "median_ms": 9.0})
    told = cells("goals.table", [{"device": "a CPU", "kind": "cpu", "copy": {}, "substep": rows}])
    assert [row[1:] for row in told] == [["1.2 ms", "yes", "1 ms", "no"], ["3.4 ms", "no", "2 ms", "no"]]
