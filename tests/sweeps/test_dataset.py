"""A sweep as a data set."""

import json
import shutil

import numpy as np
import torch
from PIL import Image
from shared import value_error
from torch.utils.data import DataLoader

from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.sweeps.dataset import SweepDataset


def test_items(undisturbed):
    data = SweepDataset(undisturbed, positions=True, nodes=True)
    assert len(data) == 8
    assert data.parameter_names == ["wind.flow.0", "wind.flow.1", "wind.flow.2", "material.E", "wind.seed"]
    item, place = data[6], undisturbed / "runs/00006"
    summary = json.loads((place / "summary.json").read_text())
    assert item["run"] == "00006"
    assert item["parameters"].tolist() == [8.0, 2.0, 0.0, 3e4, summary["seed"]]
    figures = dict(zip(data.summary_names, item["summary"].tolist(), strict=True))
    assert figures["wind_work_J"] == summary["wind_work_J"]
    assert figures["frames"] == 12
    assert (item["frames"].shape, item["frames"].dtype) == ((12, 3, 18, 32), torch.uint8)
    with Image.open(place / "frames/00007.png") as image:
        assert np.array_equal(item["frames"][7].permute(1, 2, 0).numpy(), np.asarray(image))
    assert torch.equal(item["positions"][11], load_trajectory(place / "trajectory.npz", 11)[0])
    assert torch.equal(item["nodes"], load_nodes(place / "nodes.npz"))


def test_batches(undisturbed):
    batches = list(DataLoader(SweepDataset(undisturbed), batch_size=4))
    assert [batch["frames"].shape for batch in batches] == [(4, 12, 3, 18, 32)] * 2
    assert batches[1]["run"] == ["00004", "00005", "00006", "00007"]
    assert batches[0]["parameters"].dtype == torch.float64


def _small_copy(undisturbed, folder):
    """The record and results of a sweep, without its runs."""
    folder.mkdir()
    shutil.copy(undisturbed / "sweep.json", folder)
    shutil.copytree(undisturbed / "results", folder / "results")
    return folder


def test_only_complete_runs(undisturbed, tmp_path):
    folder = _small_copy(undisturbed, tmp_path / "some")
    (folder / "results/00000.json").write_text(json.dumps({"status": "failed", "reason": "It was too windy."}))
    (folder / "results/00003.json").unlink()
    data = SweepDataset(folder, frames=False)
    assert data.runs == ["00001", "00002", "00004", "00005", "00006", "00007"]
    assert data.settings[0]["wind.flow"] == [4.0, 1.0, 0.0]
    assert set(data[0]) == {"run", "parameters", "summary"}


def test_text_and_vectors_on_axes(undisturbed, tmp_path):
    folder = _small_copy(undisturbed, tmp_path / "some")
    record = json.loads((folder / "sweep.json").read_text())
    for number, run in enumerate(record["runs"]):
        run |= {"material.law": "Sand", "flag": number > 3, "long": [1.0] * (1 + number % 2), "none": None}
    (folder / "sweep.json").write_text(json.dumps(record))
    data = SweepDataset(folder, frames=False)
    assert data.parameter_names[-2:] == ["wind.seed", "flag"]
    assert [int(data[place]["parameters"][-1]) for place in (3, 4)] == [0, 1]


def test_what_was_not_recorded_is_told(undisturbed, tmp_path):
    folder = _small_copy(undisturbed, tmp_path / "some")
    for wanted, setting in (("frames", "renders"), ("positions", "trajectory"), ("nodes", "nodes")):
        data = SweepDataset(folder, **{"frames": False, wanted: True})
        with value_error(f"leave out `{wanted}`, or sweep with recorder.{setting}"):
            data[0]
    with value_error(r"not the folder of a sweep"):
        SweepDataset(tmp_path)
    shutil.rmtree(folder / "results")
    with value_error(r"finish it with --resume"):
        SweepDataset(folder)
