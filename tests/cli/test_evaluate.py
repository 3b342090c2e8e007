"""tools/eval.py on a run of tools/sim.py, and the one sentence it answers bad input with."""

import json
import shutil

import numpy as np
import pytest
import torch
from shared import SMALL, refused, words

from gaussian_swaying.cli.evaluate import main
from gaussian_swaying.cli.simulate import main as simulate
from gaussian_swaying.recording.trajectory import load_trajectory

SIDE = 1.2
CENTRE = torch.tensor([0.6, 0.0, 0.4])  # of the flag's box, where the simulation has its origin


def _simulate(folder, gravity):
    settings = SMALL | {"solver.gravity": [0, 0, gravity], "recorder.video": False, "frames": 4}
    assert simulate(["--config=flag", "--device=cpu", f"--output={folder}", *words(settings)]) == 0


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("eval")
    run, reference = folder / "run", folder / "reference"
    _simulate(run, -9.8)
    _simulate(folder / "other", -40.0)
    shutil.copytree(folder / "other/frames", reference / "frames")
    positions = np.stack([load_trajectory(folder / "other/trajectory.npz", i)[0] + CENTRE for i in range(4)])
    i = np.arange(12 * 8).reshape(12, 8)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    np.savez(reference / "cloth.npz", positions=positions, faces=faces, side=SIDE)
    return run, reference


def test_a_run_beside_a_reference(folders, tmp_path, capsys):
    run, reference = folders
    output = tmp_path / "out"
    assert main([str(run), str(reference), "--output", str(output), "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    result = json.loads((output / "eval.json").read_text())
    assert (output / "eval.md").read_text() in printed
    assert f"wrote {output / 'comparison.mp4'}" in printed
    assert (output / "comparison.mp4").stat().st_size > 500
    assert (result["frames"], result["size"]) == (4, [32, 18])
    rows = result["per_frame"]
    # both begin at rest, with the same picture and on the same surface; later the reference is lower
    assert rows[0]["mse"] == 0.0
    assert rows[3]["mse"] > 0.0
    excess = [row["run_to_reference_m"] - rows[0]["run_to_reference_m"] for row in rows]
    assert excess[3] > excess[1] >= 0
    assert rows[0]["run_to_reference_m"] < 0.01
    assert result["chamfer_share"] == pytest.approx(result["mean"]["chamfer_m"] / SIDE)


def test_options(folders, tmp_path):
    run, reference = folders
    command = [str(run), str(reference), "--output", str(tmp_path / "out"), "--device", "cpu", "--no-video"]
    command += ["--reference-offset", "1", "--frames", "3", "--side", "2", "--points", "50", "--seed", "7"]
    assert main(command) == 0
    result = json.loads((tmp_path / "out/eval.json").read_text())
    assert [row["reference_frame"] for row in result["per_frame"]] == [1, 2, 3]
    assert (result["side_m"], result["reference_points"], result["run_points"], result["seed"]) == (2.0, 50, 50, 7)
    assert not (tmp_path / "out/comparison.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere", "REFERENCE"], ["The run folder nowhere does not exist", "folder of a simulation"]),
        (["RUN", "nowhere"], ["The reference folder nowhere does not exist"]),
        (["RUN", "REFERENCE", "--reference-offset", "1"], ["4 pictures in", "--frames 3"]),
        (["RUN", "REFERENCE", "--points", "0"], ["`points`", "positive"]),
    ],
)
def test_bad_input_is_one_sentence(folders, tmp_path, capsys, arguments, told):
    names = {"RUN": str(folders[0]), "REFERENCE": str(folders[1])}
    arguments = [names.get(argument, argument) for argument in arguments]
    refused(main, [*arguments, "--output", str(tmp_path / "a/out")], capsys, *told, folder=tmp_path)
