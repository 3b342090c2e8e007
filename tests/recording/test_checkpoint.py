"""A checkpoint that is not what the run wrote is refused in one sentence, and no code in it is executed."""

import json
import math
import pickle
import shutil
import traceback

import pytest
import torch
from damage import Fuse
from shared import contents, value_error

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.checkpoint import log_lines, read_checkpoint
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.runs.saved import save_whole
from gaussian_swaying.simulation.body import Scene
from gaussian_swaying.simulation.simulation import Simulation

QUIET = {"renders": []}


def test_what_is_no_checkpoint_changes_nothing(make_simulation, tmp_path):
    simulation, folder = make_simulation(), tmp_path / "run"
    file = folder / "checkpoint.pt"

    def go(frames, resume):
        return simulation.run(folder, frames, resume=resume, progress=False, recorder=Recorder(**QUIET))

    go(2, False)
    content = file.read_bytes()
    for broken in (b"", b"hello", content[: len(content) // 2], pickle.dumps({"frame": 1})):
        file.write_bytes(broken)
        before = contents(folder)
        with value_error(r"^[^\n]*checkpoint\.pt cannot be read .* start again without --resume\.$"):
            go(3, True)
        assert contents(folder) == before
    file.write_bytes(content)
    assert go(3, True)["status"] == "complete"


def test_a_disk_that_is_full_is_named_with_the_file(make_simulation, tmp_path, monkeypatch):
    def fail(*given):
        raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 128 vs 0")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match=r"^checkpoint\.pt could not be written: the disk may be full"):
        make_simulation().run(tmp_path / "run", 2, progress=False, recorder=Recorder(**QUIET))
    assert not list((tmp_path / "run").glob("*checkpoint*"))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("bare", [False, True])
def test_a_checkpoint_executes_no_code(tmp_path, bare):
    """PyTorch's message names the argument that would; neither the error nor what is printed of its causes does."""
    file, held = tmp_path / "checkpoint.pt", {"fuse": Fuse(tmp_path / "burnt")}
    if bare:  # a pickle as it is, not in the archive of `torch.save`
        file.write_bytes(pickle.dumps(held))
    else:
        save_whole(file, held)
    with value_error("more than tensors, numbers and text") as caught:
        read_checkpoint(file)
    assert "weights_only" not in "".join(traceback.format_exception(caught.value, limit=0))
    assert not (tmp_path / "burnt").exists()


def test_a_splat_that_was_exchanged(make_cloud, tmp_path):
    file, folder, cloud = tmp_path / "splat.ply", tmp_path / "run", make_cloud()

    def go(frames, resume, given=None):
        scene, camera = Scene(ply=str(file)), OrbitCamera(width=8, height=8)
        simulation = Simulation(scene, solver=MPMSolver(0.25), camera=camera, device="cpu", cloud=given)
        simulation.run(folder, frames, resume=resume, progress=False, recorder=Recorder(**QUIET))

    write_ply(file, cloud)
    go(2, False)
    other = shutil.copy(file, tmp_path / "other.ply")
    cloud.means[0] += 0.01
    write_ply(file, cloud)
    with value_error(r"splat .*splat.ply has changed since .* restore the old file, or start"):
        go(3, True)
    shutil.copy(other, file)
    with value_error(r"holds \d+ particles, but the scene has \d+: resume with the same splat"):
        go(3, True, make_cloud(20))
    go(3, True)


def test_the_lines_of_a_log_are_made_once():
    """Numbers come back to the last bit, and so does what is not finite."""
    log, known = [{"a": 1, "b": 0.1}], []
    first = log_lines(log, known)
    log += [{"a": 2, "b": math.inf}]
    log[0]["b"] = 7.0  # its line is known
    assert log_lines(log, known) == known
    assert len(first) == 1
    assert [json.loads(line) for line in known] == [{"a": 1, "b": 0.1}, {"a": 2, "b": math.inf}]
