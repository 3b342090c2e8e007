"""The command line of the converter."""

import json

import pytest
import torch
from shared import refused

from gaussian_swaying.cli.export import main
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.ply import read_ply, write_ply
from gaussian_swaying.scenes.procedural import FlagScene


def _run(folder, **changes):
    """A folder as a run leaves it, whose scene has y down and units of half a metre."""
    (folder / "ply").mkdir(parents=True)
    for frame in range(2):
        write_ply(folder / "ply" / f"{frame:05d}.ply", FlagScene(spacing=0.1).generate())
    place = {"origin": [0, 0, 0], "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "metres_per_unit": 0.5}
    (folder / "run.json").write_text("{}")
    (folder / "summary.json").write_text(json.dumps({"sim_frame": place, "frame_dt_s": 0.1} | changes))
    return folder


def _declared(path):
    """Frames per second, metres per unit and the direction within the scene that the stage shows as up."""
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = usd.Stage.Open(str(path))
    assert geom.GetStageUpAxis(stage) == "Z"
    matrix = geom.Xform(stage.GetPrimAtPath("/World")).GetLocalTransformation()
    up = matrix.GetInverse().TransformDir((0.0, 0.0, 1.0))
    return stage.GetFramesPerSecond(), geom.GetStageMetersPerUnit(stage), [round(float(v), 6) + 0.0 for v in up]


def test_usd_takes_the_frame_of_the_run(tmp_path, capsys):
    pytest.importorskip("pxr")
    run = _run(tmp_path / "run")
    assert main([str(run / "ply"), str(tmp_path / "film.usdc")]) == 0
    assert _declared(tmp_path / "film.usdc") == (10.0, 0.5, [0.0, -1.0, 0.0])
    assert "1 scene unit = 0.5 m (from summary.json of the run)" in capsys.readouterr().out
    assert main([str(run / "ply/00001.ply"), str(tmp_path / "one.usdc")]) == 0
    assert _declared(tmp_path / "one.usdc") == (10.0, 0.5, [0.0, -1.0, 0.0])


def test_usd_as_given(tmp_path, capsys):
    pytest.importorskip("pxr")
    run = _run(tmp_path / "run")
    options = ["--up", "0", "2", "0", "--metres-per-unit", "3", "--fps", "5"]
    assert main([str(run / "ply"), str(tmp_path / "film.usdc"), *options]) == 0
    assert _declared(tmp_path / "film.usdc") == (5.0, 3.0, [0.0, 1.0, 0.0])
    assert main([str(run / "ply"), str(tmp_path / "film.usdc"), "--metres-per-unit", "3"]) == 0
    assert _declared(tmp_path / "film.usdc") == (10.0, 3.0, [0.0, -1.0, 0.0])
    write_ply(tmp_path / "flag.ply", FlagScene(spacing=0.1).generate())
    capsys.readouterr()
    assert main([str(tmp_path / "flag.ply"), str(tmp_path / "flag.usdc")]) == 0
    assert _declared(tmp_path / "flag.usdc") == (25.0, 1.0, [0.0, 0.0, 1.0])
    assert "(by default)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["film.usdc", "--up", "0", "0", "0"], "zero"),
        (["film.usdc", "--metres-per-unit", "-1"], "`--metres-per-unit` to be positive"),
        (["film.usdc", "--fps", "nan"], "--fps"),
        (["film.splat", "--up", "0", "0", "1"], "--up and --metres-per-unit are only for USD and glTF"),
    ],
)
def test_bad_options(options, message, tmp_path, capsys):
    run = _run(tmp_path / "run")
    target = tmp_path / options[0]
    refused(main, [str(run / "ply/00000.ply"), str(target), *options[1:]], capsys, message, folder=tmp_path)


@pytest.mark.parametrize("changes", [{"sim_frame": None}, {"sim_frame": {"origin": [0]}}, {"frame_dt_s": 0}])
def test_damaged_summary(changes, tmp_path, capsys):
    run = _run(tmp_path / "run", **changes)
    words = "summary.json cannot be used", "set --up, --metres-per-unit and --fps instead"
    refused(main, [str(run / "ply"), str(tmp_path / "film.usdc")], capsys, *words)


def test_the_version_of_spz(tmp_path, capsys):
    pytest.importorskip("zstandard")
    write_ply(tmp_path / "flag.ply", FlagScene(spacing=0.1).generate())
    assert main([str(tmp_path / "flag.ply"), str(tmp_path / "3.spz")]) == 0
    assert main([str(tmp_path / "3.spz"), str(tmp_path / "4.spz"), "--spz-version", "4"]) == 0
    assert (tmp_path / "3.spz").read_bytes()[:2] == b"\x1f\x8b"
    assert (tmp_path / "4.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"
    assert len(read_gaussians(tmp_path / "4.spz")) == 96
    capsys.readouterr()
    given = [str(tmp_path / "3.spz"), str(tmp_path / "a.splat"), "--spz-version=4"]
    refused(main, given, capsys, "--spz-version is only for .spz files: leave it out")
    refused(main, ["run", "--web", "--spz-version=4"], capsys, "--spz-version is not for --web")


def test_gltf_takes_the_frame_of_the_run(tmp_path, capsys):
    """y is up in the file, and -y is in the run; its units are half a metre."""
    run = _run(tmp_path / "run")
    assert main([str(run / "ply/00001.ply"), str(tmp_path / "one.glb")]) == 0
    assert "1 scene unit = 0.5 m (from summary.json of the run)" in capsys.readouterr().out
    flag, found = read_ply(run / "ply/00001.ply"), read_gaussians(tmp_path / "one.glb")
    torch.testing.assert_close(found.means[:, 1], -0.5 * flag.means[:, 1])
    assert main([str(tmp_path / "one.glb"), str(tmp_path / "two.glb"), "--up", "0", "1", "0"]) == 0
    torch.testing.assert_close(read_gaussians(tmp_path / "two.glb").means[:, 1], found.means[:, 1])
