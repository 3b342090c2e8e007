"""``bench.py backward`` measures, records and shows what a gradient costs."""

import json

import pytest
import torch
from bench.cases import backward

from .conftest import cells, shown


def test_backward_is_measured_and_shown(bench, tmp_path, monkeypatch):
    bench("backward", "--device", "cpu", "--points", "64", "--steps", "2", "--repeats", "2", "--long", "20",
          "--results", tmp_path)  # fmt: skip
    found = json.loads((tmp_path / "backward_cpu.json").read_text())
    assert [row["pin"] for row in found["rows"]] == ["hinge", None, "nodes", "hinge"]
    assert all(row["ratio"] > 0 for row in found["rows"])
    assert [row["steps"] for row in found["memory"]] == [20, 1]
    for row in found["agreement"]:
        assert max(row["torch"].values()) < 1e-2
    told = [line for part in ("rows", "memory", "agreement") for line in shown(f"backward.{part}", found)]
    assert any("| 64 | hinge | springs | torch |" in line for line in told)
    assert not any("failed" in line for line in told)


def test_goals_say_what_was_reached():
    time = {"median_ms": 0.1}
    row = {"points": 99_856, "pin": "hinge", "law": "springs", "by": "kernels", "plain": time, "ratio": 4.5}
    memory = {"points": 99_856, "steps": 2000, "by": "kernels", "checkpoint": 0, "memory_bytes": 2**30}
    others = [row | {"by": "torch"}, row | {"points": 10_000}]
    found = cells("backward.goals", {"rows": [row, *others], "memory": [memory]})
    assert [one[1:] for one in found] == [["at most 4 forward", "4.5", "no"], ["at most 2 GiB", "1.00 GiB", "yes"]]
    failed = {"device": "a", "versions": {}, "rows": [{"points": 9, "pin": None, "law": "springs", "transfer": "auto"}]}
    failed["rows"][0]["failed"] = "out of memory"
    assert cells("backward.rows", failed) == [["9", "no", "springs", "auto", "failed: out of memory", "-", "-", "-"]]


def test_unknowns_of_the_sheet_move_it():
    """The density is a leaf behind the mass, E behind the stiffness: no gradient vanishes."""
    case = backward.Sheet(64, torch.device("cpu"), "hinge", dtype=torch.float64)
    assert list(case.leaves) == list(backward.SOUGHT)
    for gradient in case.gradients(4):
        assert float(gradient.abs().max()) > 0
    with pytest.raises(RuntimeError):
        torch.autograd.grad(case.loss(case.state.replace(position=case.state.position.detach())), case.leaves["E"])
