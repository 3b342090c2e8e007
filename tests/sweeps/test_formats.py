import json
import shutil
import tarfile

import numpy as np
import pytest
from PIL import Image
from shared import rows, value_error

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.recording.nodes import load_nodes
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.sweeps.dataset import SUMMARY, write_shards, write_tables
from gaussian_swaying.sweeps.plan import Plan


def test_parquet(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    runs = [{"wind.flow": [k, 0.5, 0], "material.E": 1e3, "wind.seed": k, "law": {"a": k}} for k in range(3)]
    figures = {name: None for name in SUMMARY} | {"frames": 5, "substeps": 7.0, "warnings": 0}
    results = {"00000": {"status": "complete", "reason": None, "figures": figures}}
    results["00001"] = {"status": "failed", "reason": "It broke."}
    write_tables(tmp_path, Plan("", 5, tuple(runs), {}), results, parquet=True)
    table = parquet.read_table(tmp_path / "sweep.parquet").to_pydict()
    assert table["run"] == ["00000", "00001", "00002"]
    assert table["status"] == ["complete", "failed", "missing"]
    assert table["reason"] == [None, "It broke.", None]
    assert table["wind.flow"] == [[0.0, 0.5, 0.0], [1.0, 0.5, 0.0], [2.0, 0.5, 0.0]]
    assert table["material.E"] == [1e3] * 3
    assert table["wind.seed"] == [0, 1, 2]
    assert table["law"] == ['{"a": 0}', '{"a": 1}', '{"a": 2}']
    assert table["frames"] == [5, None, None]
    assert table["kinetic_end_J"] == [None] * 3


def test_the_parquet_of_a_sweep(undisturbed, tmp_path, sweep_file):
    parquet = pytest.importorskip("pyarrow.parquet")
    file = sweep_file(tmp_path / "tiny.yaml")
    assert main([str(file), "--output", str(undisturbed), "--resume", "--parquet"]) == 0
    table = parquet.read_table(undisturbed / "sweep.parquet").to_pydict()
    expected = rows(undisturbed / "sweep.csv")
    assert list(table) == list(expected[0])
    assert table["wind_work_J"] == [float(row["wind_work_J"]) for row in expected]
    (undisturbed / "sweep.parquet").unlink()


def _read(files):
    import webdataset

    return list(webdataset.WebDataset([str(file) for file in files], shardshuffle=False).decode("rgb8"))


def test_shards(undisturbed, tmp_path):
    pytest.importorskip("webdataset")
    files = write_shards(undisturbed, 3, tmp_path / "shards", positions=True, nodes=True)
    assert [file.name for file in files] == ["000000.tar", "000001.tar", "000002.tar"]
    samples = _read(files)
    assert [sample["__key__"] for sample in samples] == [f"{number:05d}" for number in range(8)]
    item, place = samples[6], undisturbed / "runs/00006"
    summary, told = json.loads((place / "summary.json").read_text()), item["json"]
    assert told["run"] == "00006"
    assert told["settings"] == json.loads((undisturbed / "sweep.json").read_text())["runs"][6]
    assert told["parameter_names"] == ["wind.flow.0", "wind.flow.1", "wind.flow.2", "material.E", "wind.seed"]
    assert item["parameters.npy"].tolist() == [8.0, 2.0, 0.0, 3e4, summary["seed"]]
    assert item["parameters.npy"].dtype == np.float64
    assert told["summary"]["wind_work_J"] == summary["wind_work_J"]
    assert told["summary"]["frames"] == 12
    with Image.open(place / "frames/00007.png") as image:
        assert np.array_equal(item["00007.png"], np.asarray(image.convert("RGB")))
    assert sum(name.endswith(".png") for name in item) == 12
    assert np.array_equal(item["positions.npy"][11], load_trajectory(place / "trajectory.npz", 11)[0].numpy())
    assert np.array_equal(item["nodes.npy"], load_nodes(place / "nodes.npz").numpy())
    again = write_shards(undisturbed, 3, tmp_path / "again", positions=True, nodes=True)
    assert [a.read_bytes() for a in files] == [b.read_bytes() for b in again]
    (larger,) = write_shards(undisturbed, 100, tmp_path / "shards", frames=False)
    assert [file.name for file in (tmp_path / "shards").iterdir()] == [larger.name]


def _small_copy(undisturbed, folder):
    folder.mkdir()
    shutil.copy(undisturbed / "sweep.json", folder)
    shutil.copytree(undisturbed / "results", folder / "results")
    return folder


def test_only_complete_runs(undisturbed, tmp_path):
    pytest.importorskip("webdataset")
    folder = _small_copy(undisturbed, tmp_path / "some")
    (folder / "results/00000.json").write_text(json.dumps({"status": "failed", "reason": "It was too windy."}))
    (folder / "results/00003.json").unlink()
    samples = _read(write_shards(folder, frames=False))
    assert [s["__key__"] for s in samples] == ["00001", "00002", "00004", "00005", "00006", "00007"]
    assert samples[0]["json"]["settings"]["wind.flow"] == [4.0, 1.0, 0.0]


def test_text_and_vectors_on_axes(undisturbed, tmp_path):
    pytest.importorskip("webdataset")
    folder = _small_copy(undisturbed, tmp_path / "some")
    record = json.loads((folder / "sweep.json").read_text())
    for number, run in enumerate(record["runs"]):
        run |= {"material.law": "Sand", "flag": number > 3, "long": [1.0] * (1 + number % 2), "none": None}
    (folder / "sweep.json").write_text(json.dumps(record))
    samples = _read(write_shards(folder, frames=False))
    assert samples[0]["json"]["parameter_names"][-2:] == ["wind.seed", "flag"]
    assert [samples[place]["parameters.npy"][-1] for place in (3, 4)] == [0, 1]


def test_what_was_not_recorded_is_told(undisturbed, tmp_path):
    pytest.importorskip("webdataset")
    folder = _small_copy(undisturbed, tmp_path / "some")
    for wanted, setting in (("frames", "renders"), ("positions", "trajectory"), ("nodes", "nodes")):
        with value_error(f"leave out `{wanted}`, or sweep with recorder.{setting}"):
            write_shards(folder, **{"frames": False, wanted: True})
    with value_error(r"not the folder of a sweep"):
        write_shards(tmp_path)
    shutil.rmtree(folder / "results")
    with value_error(r"finish it with --resume"):
        write_shards(folder)


def test_the_shards_of_a_sweep(undisturbed, tmp_path, sweep_file, capsys):
    pytest.importorskip("webdataset")
    file = sweep_file(tmp_path / "tiny.yaml")
    assert main([str(file), "--output", str(undisturbed), "--resume", "--shards", "8"]) == 0
    assert f"wrote {undisturbed / 'shards'}" in capsys.readouterr().out
    with tarfile.open(undisturbed / "shards/000000.tar") as tar:
        assert "00007.positions.npy" in tar.getnames()
    assert main([str(file), "--output", str(undisturbed), "--resume", "--shards", "0"]) == 2
