"""Each command on a small input, as a user types it: what it writes, and that the next command takes it."""

import json
import shlex

import pytest
import torch
import yaml
from shared import SMALL, peak, refused, words

from gaussian_swaying import read_gaussians, write_ply
from gaussian_swaying.cli.main import main
from gaussian_swaying.gaussians.formats import FORMATS
from gaussian_swaying.scenes import FlagScene

FLAG = FlagScene(spacing=0.1).generate()
PHYSGAUSSIAN = {
    "material": "jelly", "E": 2e6, "nu": 0.4, "density": 200, "substep_dt": 1e-4, "frame_dt": 0.04, "frame_num": 3,
    "g": [0, 0, 0], "grid_v_damping_scale": 0.9999, "n_grid": 10, "additional_material_params": [],
    "boundary_conditions": [{"type": "bounding_box"}],
}  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_ply("flag.ply", FLAG)
        assert main(["sim", "--config=flag", "--device=cpu", "--frames=4", "--output=run", *words(SMALL)]) == 0
        yield folder


def works(line, *more):
    assert main([*shlex.split(line), *more]) == 0


def test_sim(place, capsys):
    works("sim --config=flag --device=cpu --frames=2 --output=again", *words(SMALL))
    out = capsys.readouterr().out
    assert "96 of 2,056 Gaussians simulated on cpu" in out
    assert "1 scene unit = 1 m" in out
    for name in ("video.mp4", "trajectory.npz", "summary.json", "frames", "diagnostics.csv", "checkpoint.pt"):
        assert f"wrote again/{name}\n" in out
        assert (place / "again" / name).exists()
    summary = json.loads((place / "again/summary.json").read_text())
    assert (summary["status"], summary["frames"]) == ("complete", 2)


def test_eval(place):
    works("eval run run --device=cpu --no-video")
    found = json.loads((place / "run/eval/eval.json").read_text())
    assert [row["mse"] for row in found["per_frame"]] == [0.0] * 4


@pytest.mark.parametrize("suffix", [format.endings[0] for format in FORMATS.values()])
def test_export(place, suffix):
    if suffix == ".usdc":
        pytest.importorskip("pxr")
    works(f"export flag.ply flag{suffix} --up 0 0 1" if suffix in (".glb", ".usdc") else f"export flag.ply b{suffix}")
    if suffix == ".usdc":  # for other programs: this package does not read it
        assert (place / "flag.usdc").stat().st_size > 1000
        return
    found = read_gaussians(place / ("flag.glb" if suffix == ".glb" else f"b{suffix}")).means
    if suffix == ".glb":
        found = torch.stack([found[:, 0], -found[:, 2], found[:, 1]], -1)
    apart = torch.cdist(FLAG.means, found)
    assert len(found) == 96
    assert apart.amin(1).max() < 1.2e-3  # formats may sort


def test_export_of_a_run(place):
    works("export run frames/flag_###.spz")
    assert sorted(path.name for path in (place / "frames").iterdir()) == [f"flag_{k:03d}.spz" for k in range(4)]
    moved = [read_gaussians(place / f"frames/flag_{k:03d}.spz").means for k in (0, 3)]
    assert peak(moved[1] - moved[0]) > 1e-3


def test_preview(place, capsys):
    works("preview flag.ply --hold=-x --frames=3 --height=96 --device=cpu --output=look")
    assert "--config look/starter.yaml" in capsys.readouterr().out
    assert (place / "look/preview.png").stat().st_size > 1000
    works("sim --config look/starter.yaml --device=cpu --output swayed", *words({"recorder.video": False}))
    assert json.loads((place / "swayed/summary.json").read_text())["displacement_mean_max_m"] > 1e-4


def test_convert(place):
    (place / "jelly.json").write_text(json.dumps(PHYSGAUSSIAN))
    works("convert jelly.json --output jelly.yaml")
    assert yaml.safe_load((place / "jelly.yaml").read_text())["material"]["E"] == 2e6


def test_sweep(place, capsys):
    settings = SMALL | {"frames": 2, "recorder.video": False}
    plan = {"base": "flag", "settings": settings, "axes": {"material.E": [1e4, 2e4]}}
    (place / "two.yaml").write_text(yaml.safe_dump(plan))
    works("sweep two.yaml --workers=1 --device=cpu")
    out = capsys.readouterr().out
    assert "2 runs: 2 complete" in out
    for name in ("runs", "sweep.csv", "contact_sheet.png"):
        assert f"wrote outputs/sweeps/two/{name}\n" in out
        assert (place / "outputs/sweeps/two" / name).exists()


def test_train(place):
    """On photos of a generated flag, in Lightning: held-out photos are met better, and the splat is one to simulate."""
    brief = {"trainer.max_steps": 60, "trainer.val_check_interval": 20, "trainer.enable_progress_bar": False}
    brief |= {"checkpoint.every_n_train_steps": 60, "data.init_args.capture.size": 32}
    works("train fit --config=quick_cpu", *words(brief))
    folder = place / "outputs/train/quick_cpu"
    names, *rows = [line.split(",") for line in (folder / "csv/metrics.csv").read_text().splitlines()]
    psnr = [float(row[names.index("val/psnr")]) for row in rows if row[names.index("val/psnr")]]
    assert psnr[-1] > psnr[0] + 1.0
    works(f"preview {folder / 'point_cloud.ply'} --frames=2 --height=96 --device=cpu --output=trained")
    assert (place / "trained/starter.yaml").exists()


EMPTY = {"class_path": "Box", "init_args": {"min": [5, 5, 5], "max": [6, 6, 6]}}
INSIDE = {"class_path": "LookAtCamera", "init_args": {"eye": [0.6, 0.0, 0.4], "target": [0.6, 1.0, 0.4]}}


@pytest.mark.parametrize(
    ("changes", "words_told"),
    [
        ({"config": "/nowhere/at_all.yaml"}, ["/nowhere/at_all.yaml", "does not exist"]),
        ({"scene.ply": "none.ply"}, ["none.ply"]),
        ({"wind.flwo": [1, 0, 0]}, ["--wind.flwo", "wind.flow"]),
        ({"scene.region": EMPTY}, ["No Gaussian is selected", "Box(min=[5,", "move the region"]),
        ({"scene.opacity_threshold": 0.999}, ["opacity threshold", "lower the threshold"]),
        ({"scene.longest_side": 1.0}, ["longest_side", "metres_per_unit", "not both"]),
        (
            {"solver.boundaries": [{"class_path": "PinnedRegion", "init_args": {"region": EMPTY}}]},
            ["holds no particle", "`region`"],
        ),
        ({"solver.substep": 1.0}, ["`substep` of 1 s", "stable one of 0.0", "lower it"]),
        ({"material.nu": 0.5}, ["`material.nu`", "0.49"]),
        ({"camera": INSIDE}, ["camera", "inside the object", "move it out"]),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_the_commonest_mistakes_are_one_sentence(place, capsys, changes, words_told):
    refused(main, ["sim", "--config=flag", *words(SMALL | changes), "--output=no"], capsys, *words_told, folder=place)
