"""``gaussian-swaying sweep``: what it prints, and the one sentence it answers bad input with."""

import pytest
import yaml
from shared import refused

from gaussian_swaying.cli import shipped
from gaussian_swaying.cli.main import main as program
from gaussian_swaying.cli.sweep import main


def _file(path, **fields):
    path.write_text(yaml.safe_dump({"base": "flag", "settings": {"frames": 3}} | fields, sort_keys=False))
    return str(path)


def test_the_list_of_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    axes = {"wind.flow": [[4, 0, 0], [8, 0, 0]], "material.E": {"from": 1e3, "to": 2e3, "count": 2}}
    assert main([_file(tmp_path / "a.yaml", axes=axes), "--list"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "00000  wind.flow [4, 0, 0], material.E 1000.0",
        "00001  wind.flow [4, 0, 0], material.E 2000.0",
        "00002  wind.flow [8, 0, 0], material.E 1000.0",
        "00003  wind.flow [8, 0, 0], material.E 2000.0",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["a.yaml"]


def test_a_shipped_sweep_by_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert "flag_winds" in shipped.names("sweep")
    assert main(["flag_winds", "--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 18
    refused(main, ["flag_wind"], capsys, "'flag_wind' (did you mean flag_winds?)", folder=tmp_path)


@pytest.mark.parametrize(("extra", "module"), [("parquet", "pyarrow"), ("ray", "ray"), ("shards 9", "webdataset")])
def test_a_missing_extra_leaves_nothing_behind(extra, module, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gaussian_swaying.sweeps.run.find_spec", lambda name: None)
    file = _file(tmp_path / "a.yaml", axes={"material.E": [1e3, 2e3]})
    given = [file, *f"--{extra}".split(), "--output", str(tmp_path / "out")]
    refused(main, given, capsys, f"install {module}", folder=tmp_path)


def test_bad_input(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flow = {"wind.flow": [[4, 0, 0]]}
    bad = [
        (_file(tmp_path / "a.yaml", axes={"wind.flwo": [[4, 0, 0]]}), [], ("did you mean", "wind.flow?")),
        (_file(tmp_path / "b.yaml", axes=flow, base="flga"), [], ("'flga' (did you mean flag?)",)),
        (_file(tmp_path / "d.yaml", axes=flow), ["--workers", "0"], ("`workers`", "at least 1")),
        (_file(tmp_path / "d.yaml", axes=flow), ["--retries", "-1"], ("`retries`", "at least 0")),
        ("missing.yaml", [], ("missing.yaml does not exist",)),
    ]
    for file, more, words in bad:
        refused(main, [file, *more], capsys, *words, folder=tmp_path)


def test_unknown_options_end_with_usage(capsys):
    with pytest.raises(SystemExit) as left:
        program(["sweep", "flag_winds", "--worker-count", "3"])
    assert left.value.code == 2
