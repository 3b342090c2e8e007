"""The table as Parquet, and the runs as WebDataset shards, read back."""

import io
import json
import tarfile

import numpy as np
import pytest
from PIL import Image
from shared import rows

from gaussian_swaying.cli.sweep import main
from gaussian_swaying.sweeps import record
from gaussian_swaying.sweeps.dataset import SweepDataset, write_shards
from gaussian_swaying.sweeps.plan import Plan
from gaussian_swaying.sweeps.record import write_tables


def test_parquet(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    runs = [{"wind.flow": [k, 0.5, 0], "material.E": 1e3, "wind.seed": k, "law": {"a": k}} for k in range(3)]
    figures = {name: None for name in record.SUMMARY} | {"frames": 5, "substeps": 7.0, "warnings": 0}
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


def test_shards(undisturbed, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    files = write_shards(undisturbed, 3, tmp_path / "shards", positions=True)
    assert [file.name for file in files] == ["000000.tar", "000001.tar", "000002.tar"]
    data, seen = SweepDataset(undisturbed, positions=True), []
    for file in files:
        with tarfile.open(file) as tar:
            names = tar.getnames()
            keys = [name.partition(".")[0] for name in names]
            assert keys == sorted(keys)  # what belongs together follows each other
            for run in dict.fromkeys(keys):
                item = data[len(seen)]
                seen.append(run)
                told = json.load(tar.extractfile(f"{run}.json"))
                assert told["run"] == run
                assert told["settings"] == data.settings[len(seen) - 1]
                stored = np.load(io.BytesIO(tar.extractfile(f"{run}.positions.npy").read()))
                assert np.array_equal(stored, item["positions"].numpy())
                stored = np.load(io.BytesIO(tar.extractfile(f"{run}.parameters.npy").read()))
                assert np.array_equal(stored, item["parameters"].numpy())
                with Image.open(tar.extractfile(f"{run}.00011.png")) as picture:
                    shown = np.asarray(picture.convert("RGB")).transpose(2, 0, 1)
                assert np.array_equal(shown, item["frames"][11].numpy())
                assert sum(name.startswith(run) and name.endswith(".png") for name in names) == 12
    assert seen == data.runs
    again = write_shards(undisturbed, 3, tmp_path / "again", positions=True)
    assert [a.read_bytes() for a in files] == [b.read_bytes() for b in again]
    (larger,) = write_shards(undisturbed, 100, tmp_path / "shards", frames=False)
    assert [file.name for file in (tmp_path / "shards").iterdir()] == [larger.name]
    read = webdataset.WebDataset(str(tmp_path / "again/{000000..000002}.tar"), shardshuffle=False).decode("rgb8")
    samples = list(read)
    assert [sample["__key__"] for sample in samples] == data.runs
    assert samples[0]["positions.npy"].shape == data[0]["positions"].shape
    assert samples[0]["00011.png"].shape == (18, 32, 3)
    assert samples[0]["json"]["summary"]["frames"] == 12


def test_the_shards_of_a_sweep(undisturbed, tmp_path, sweep_file, capsys):
    pytest.importorskip("webdataset")
    file = sweep_file(tmp_path / "tiny.yaml")
    assert main([str(file), "--output", str(undisturbed), "--resume", "--shards", "8"]) == 0
    assert f"wrote {undisturbed / 'shards'}" in capsys.readouterr().out
    with tarfile.open(undisturbed / "shards/000000.tar") as tar:
        assert "00007.positions.npy" in tar.getnames()
    assert main([str(file), "--output", str(undisturbed), "--resume", "--shards", "0"]) == 2
