"""``bench.py leaves`` on two flags in place of leaves."""

import dataclasses

import torch
import yaml
from bench import record, slots

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.scenes.procedural import FlagScene

CONFIG = {
    "frames": 2,
    "scene": {"ply": "flags.ply", "longest_side": 0.9, "area": "coverage"},
    "material": {"E": 2e3, "density": 20.0, "thickness": 0.01},
    "solver": {
        "dx": 0.1,
        "boundaries": [
            {
                "class_path": "PinnedRegion",
                "init_args": {"region": {"class_path": "Box", "init_args": {"min": [-9, -9, -9], "max": [0.1, 9, 9]}}},
            }
        ],
    },
    "wind": {"flow": [1.0, 2.0, 0.0]},
    "recorder": {"video": False},
}


def test_flags_are_measured_and_shown(bench, tmp_path):
    """Two flags are joined at one edge by a third one across it."""
    flag = FlagScene(spacing=0.03, width=0.9, height=0.6).generate()
    far = dataclasses.replace(flag, means=flag.means + torch.tensor([0.0, 0.15, 0.0]))
    edge = flag.select(flag.means[:, 0] < 0.1)
    parts = [flag, far]
    for k in range(1, 5):
        parts.append(dataclasses.replace(edge, means=edge.means + torch.tensor([0.0, 0.03 * k, 0.0])))
    fields = {f.name: [getattr(part, f.name) for part in parts] for f in dataclasses.fields(GaussianCloud)}
    cloud = GaussianCloud(**{name: None if v[0] is None else torch.cat(v) for name, v in fields.items()})
    write_ply(tmp_path / "flags.ply", cloud)
    (tmp_path / "flags.yaml").write_text(yaml.safe_dump(CONFIG))
    options = ("--config", tmp_path / "flags.yaml", "--cells", "5,9", "--frames", 2, "--near", 0.2, "--far", 0.3)
    bench("leaves", "--device", "cpu", "--results", tmp_path / "results", *options)
    found = record.read(tmp_path / "results")["leaves_cpu"]
    assert [(row["cells"], row["connected"]) for row in found["rows"]] == [(5, "grid"), (5, "surface"), (9, "grid")]
    shared, own, _ = found["rows"]
    assert own["pairs"] > 100
    assert own["nodes"] > shared["nodes"]
    assert own["relative"] != shared["relative"]
    assert "| 9 | `grid` |" in "\n".join(slots.SLOTS["leaves.rows"].make(found))
    assert "at least 30 %" in "\n".join(slots.SLOTS["leaves.goals"].make(found))
