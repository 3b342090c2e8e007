import pytest
import torch
from shared import refused

from gaussian_swaying.cli.export import main
from gaussian_swaying.cli.simulate import main as simulate
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.ply import read_ply, write_ply
from gaussian_swaying.scenes.procedural import FlagScene


@pytest.fixture
def flag(tmp_path):
    """A flag, whose length is 0.9 m."""
    write_ply(tmp_path / "flag.ply", FlagScene(spacing=0.1).generate())
    return str(tmp_path / "flag.ply")


def _declared(path):
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = usd.Stage.Open(str(path))
    assert geom.GetStageUpAxis(stage) == "Z"
    matrix = geom.Xform(stage.GetPrimAtPath("/World")).GetLocalTransformation()
    up = matrix.GetInverse().TransformDir((0.0, 0.0, 1.0))
    return stage.GetFramesPerSecond(), geom.GetStageMetersPerUnit(stage), [round(float(v), 6) + 0.0 for v in up]


def test_usd_as_given(flag, tmp_path, capsys):
    pytest.importorskip("pxr")
    assert main([flag, str(tmp_path / "a.usdc"), "--up", "0", "2", "0", "--metres-per-unit", "3"]) == 0
    assert _declared(tmp_path / "a.usdc") == (25.0, 3.0, [0.0, 1.0, 0.0])
    assert "1 scene unit = 3 m (as given)" in capsys.readouterr().out
    assert main([flag, str(tmp_path / "b.usdc")]) == 0
    assert _declared(tmp_path / "b.usdc") == (25.0, 1.0, [0.0, 0.0, 1.0])
    assert "(by default)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["a.usdc", "--up", "0", "0", "0"], "zero"),
        (["a.usdc", "--metres-per-unit", "-1"], "`--metres-per-unit` to be positive"),
        (["a.splat", "--up", "0", "0", "1"], "--up is not for a splat as .splat: leave it out"),
        (["a.splat", "--spz-version=4"], "--spz-version is not for a splat as .splat"),
        (["a.splat", "--apart"], "--apart is not for a splat"),
        (["--web", "--spz-version=4"], "--spz-version is not for a film"),
    ],
)
def test_bad_options(options, message, flag, tmp_path, capsys):
    target = [str(tmp_path / options[0])] if options[0][0] == "a" else [options[0]]
    refused(main, [flag, *target, *options[1:]], capsys, message, folder=tmp_path)


def test_the_version_of_spz(flag, tmp_path):
    pytest.importorskip("zstandard")
    assert main([flag, str(tmp_path / "3.spz")]) == 0
    assert main([str(tmp_path / "3.spz"), str(tmp_path / "4.spz"), "--spz-version", "4"]) == 0
    assert (tmp_path / "3.spz").read_bytes()[:2] == b"\x1f\x8b"
    assert (tmp_path / "4.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"
    assert len(read_gaussians(tmp_path / "4.spz")) == 96


def test_gltf_as_given(flag, tmp_path):
    """Metres with y up in the file, whatever is up in the scene."""
    assert main([flag, str(tmp_path / "one.glb"), "--up", "0", "-1", "0", "--metres-per-unit", "0.5"]) == 0
    means, found = read_ply(flag).means, read_gaussians(tmp_path / "one.glb")
    torch.testing.assert_close(found.means[:, 1], -0.5 * means[:, 1])
    assert main([str(tmp_path / "one.glb"), str(tmp_path / "two.glb"), "--up", "0", "1", "0"]) == 0
    torch.testing.assert_close(read_gaussians(tmp_path / "two.glb").means[:, 1], found.means[:, 1])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of 6 frames at 25 a second."""
    folder = tmp_path_factory.mktemp("run")
    config = folder / "flag.yaml"
    config.write_text(
        "scene:\n  generator: {class_path: FlagScene, init_args: {spacing: 0.1}}\nframes: 6\ndevice: cpu\n"
        "solver: {dx: 0.2, boundaries: [{class_path: PinnedRegion, init_args: {region: {class_path: Box, "
        "init_args: {min: [null, null, null], max: [0.1, null, null]}}}}]}\nwind: {flow: [4, 2, 0]}\n"
        "recorder: {renders: []}\n"
    )
    assert simulate(["--config", str(config), "--output", str(folder / "run")]) == 0
    return str(folder / "run")


def test_a_part_of_a_run_at_another_rate_and_as_a_skin(run, tmp_path, capsys):
    assert main([run, str(tmp_path / "f_#.ply"), "--fps", "12.5", "--box", "0", "-1", "0", "0.5", "1", "1"]) == 0
    part, whole = read_ply(tmp_path / "f_0.ply"), len(FlagScene(spacing=0.1).generate().means)
    assert len(list(tmp_path.glob("f_*.ply"))) == 3
    assert part.means[:, 0].max() <= 0.5
    assert len(part.means) < whole
    assert len(read_ply(tmp_path / "f_2.ply").means) == len(part.means)  # those that were there at rest
    assert main([run, str(tmp_path / "flag.glb"), "--bones", "6"]) == 0
    assert "6 bones, " in capsys.readouterr().out
    assert len(read_gaussians(tmp_path / "flag.glb").means) == whole
    assert main([run, str(tmp_path / "mesh.glb"), "--bones", "6", "--proxy"]) == 0
    assert b"KHR_gaussian" not in (tmp_path / "mesh.glb").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["f_#.ply", "--fps", "10"], "--fps 12.5 is the nearest"),
        (["f_#.ply", "--fps", "0"], "25 frames a second"),
        (["f_#.ply", "--box", "5", "5", "5", "6", "6", "6"], "holds no Gaussian"),
        (["f_#.ply", "--bones", "6"], "--bones is not for the frames of a run as .ply"),
        (["f.glb", "--bones", "1"], "from 2 to 256"),
        (["f.glb", "--proxy"], "--proxy is a mesh that bones move"),
        (["f.glb", "--bones", "6", "--apart"], "--apart cannot be combined"),
        (["f_#.ply", "--box", "0", "-1", "0", "1", "1", "1", "--apart"], "--apart cannot be combined"),
    ],
)
def test_what_of_a_run_cannot_be_written(run, options, message, tmp_path, capsys):
    refused(main, [run, str(tmp_path / options[0]), *options[1:]], capsys, message, folder=tmp_path)
