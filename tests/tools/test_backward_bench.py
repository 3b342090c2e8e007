"""``bench.py backward`` measures, records and shows what a gradient costs."""

import json

import pytest
import torch
from bench.cases import backward
from bench.tables import backward as tables


def test_backward_is_measured_and_shown(bench, tmp_path, monkeypatch):
    bench("backward", "--device", "cpu", "--points", "64", "--steps", "2", "--repeats", "2", "--long", "20",
          "--results", tmp_path)  # fmt: skip
    found = json.loads((tmp_path / "backward_cpu.json").read_text())
    assert [row["pin"] for row in found["rows"]] == ["hinge", None, "nodes", "hinge"]
    assert all(row["ratio"] > 0 for row in found["rows"])
    assert [row["steps"] for row in found["memory"]] == [20, 1]
    for row in found["agreement"]:
        assert max(row["torch"].values()) < 1e-2
    shown = "\n".join([*tables.rows(found), *tables.memory(found), *tables.agreement(found)])
    assert "| 64 | hinge | springs | torch |" in shown
    assert "failed" not in shown


def test_goals_say_what_was_reached():
    time = {"median_ms": 0.1}
    row = {"points": 99_856, "pin": "hinge", "law": "springs", "by": "kernels", "plain": time, "ratio": 4.5}
    memory = {"points": 99_856, "steps": 2000, "by": "kernels", "checkpoint": 0, "memory_bytes": 2**30}
    found = tables.goals({"rows": [row, row | {"by": "torch"}, row | {"points": 10_000}], "memory": [memory]})
    assert len(found) == 4
    assert found[2].endswith("| at most 4 forward | 4.5 | no |")
    assert found[3].endswith("| 1.00 GiB | yes |")
    shown = tables.rows(
        {"device": "a", "versions": {}, "rows": [{**row, "transfer": "auto", "failed": "out of memory"}]}
    )
    assert "failed: out of memory" in shown[-1]


def test_unknowns_of_the_sheet_move_it():
    """The density is a leaf behind the mass, E behind the stiffness: no gradient vanishes."""
    case = backward.Sheet(64, torch.device("cpu"), "hinge", dtype=torch.float64)
    assert list(case.leaves) == list(backward.SOUGHT)
    for gradient in case.gradients(4):
        assert float(gradient.abs().max()) > 0
    with pytest.raises(RuntimeError):
        torch.autograd.grad(case.loss(case.state.replace(position=case.state.position.detach())), case.leaves["E"])
