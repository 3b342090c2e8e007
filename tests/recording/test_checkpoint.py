"""A checkpoint that is not what the run wrote is refused in one sentence, whatever has happened to it."""

import json
import math
import pickle
import random
import shutil
import traceback

import pytest
from damage import Fuse, damaged
from shared import contents

from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.mpm.laws.snow import Snow
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.recording.checkpoint import log_lines, read_checkpoint
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.runs.seal import check_seal, save_sealed, seal

CONFIG = "material:\n  E: 3000.0\nwind:\n  flow:\n  - 6.0\n  - 1.5\n  - 0.0\n"


@pytest.fixture(params=["total", "updated"])
def formulation(request):
    return request.param


@pytest.fixture
def run(make_simulation, tmp_path, formulation):
    """A simulation, the folder of its run of two frames, and how to go on from it to a third."""
    simulation, folder = make_simulation(formulation=formulation), tmp_path / "run"
    recorder = Recorder(video=False)
    simulation.config = CONFIG
    simulation.run(folder, 2, progress=False, recorder=recorder)

    def resume(frames=3):
        return simulation.run(folder, frames, resume=True, progress=False, recorder=recorder)

    return folder, resume


def _refused(resume, folder, case):
    """The sentence of a refusal; the folder is as it was before."""
    before = contents(folder)
    try:
        resume()
    except ValueError as error:
        assert contents(folder) == before, case
        message = str(error)
        assert "\n" not in message, case
        assert message.endswith("start again without --resume."), (case, message)
        return message
    except BaseException as error:
        raise AssertionError(f"{case} ended in {error!r}") from error
    raise AssertionError(f"{case} went on silently")


def _with_lines(checkpoint):
    """As it is written: its log as lines, of whatever is in it."""
    if isinstance(checkpoint, dict) and isinstance(checkpoint.get("log"), list):
        return checkpoint | {"log": [json.dumps(entry, default=str) for entry in checkpoint["log"]]}
    return checkpoint


def test_damaged_bytes(run):
    """None goes on silently, none ends in anything but the one sentence; then the right one goes on."""
    folder, resume = run
    file = folder / "checkpoint.pt"
    content = file.read_bytes()
    altered = content.replace(b"3000.0", b"3001.0"), content[:-90], content + b"\n", pickle.dumps({"frame": 1})
    for case, changed in enumerate([*(damaged(random.Random(k), content) for k in range(50)), *altered]):
        assert changed != content
        file.write_bytes(changed)
        assert "checkpoint.pt cannot be read as a checkpoint" in _refused(resume, folder, case)
    file.write_bytes(content)
    assert resume()["status"] == "complete"


def test_a_checkpoint_executes_no_code(tmp_path, run):
    folder, resume = run
    held = read_checkpoint(folder / "checkpoint.pt")
    held["wall_s"]["fuse"] = Fuse(tmp_path / "burnt")
    save_sealed(folder / "checkpoint.pt", _with_lines(held))
    sentence = _refused(resume, folder, "a fuse")
    assert "cannot be read as a checkpoint (it holds more than tensors, numbers and text, which is never" in sentence
    assert not (tmp_path / "burnt").exists()


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("bare", [False, True])
def test_no_advice_to_execute_the_code_in_a_file(tmp_path, bare):
    """PyTorch's message names the argument that would; neither the error nor what is printed of its causes does."""
    file, held = tmp_path / "checkpoint.pt", {"fuse": Fuse(tmp_path / "burnt")}
    if bare:  # a pickle as it is, not in the archive of `torch.save`
        file.write_bytes(pickle.dumps(held))
        seal(file)
    else:
        save_sealed(file, held)
    with pytest.raises(ValueError, match="more than tensors, numbers and text") as caught:
        read_checkpoint(file)
    assert "weights_only" not in "".join(traceback.format_exception(caught.value, limit=0))
    assert not (tmp_path / "burnt").exists()


def test_a_splat_that_was_exchanged(make_cloud, make_simulation, tmp_path):
    """As many Gaussians under the same name, one of them elsewhere."""
    from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
    from gaussian_swaying.simulation.scene import Scene
    from gaussian_swaying.simulation.simulation import Simulation

    like, file, folder = make_simulation(pinned=False), tmp_path / "splat.ply", tmp_path / "run"

    def go(frames, resume):
        camera = OrbitCamera(width=8, height=8)
        simulation = Simulation(
            Scene(ply=str(file)), None, solver=MPMSolver(dx=0.25), wind=like.wind, camera=camera, device="cpu"
        )
        simulation.run(folder, frames, resume=resume, progress=False, recorder=Recorder(images=False, video=False))

    cloud = make_cloud()
    write_ply(file, cloud)
    go(2, False)
    other = shutil.copy(file, tmp_path / "other.ply")
    cloud.means[0] += 0.01
    write_ply(file, cloud)
    with pytest.raises(ValueError, match=r"splat .*splat.ply has changed since .* restore the old file, or start"):
        go(3, True)
    shutil.copy(other, file)
    go(3, True)


@pytest.mark.parametrize("formulation", ["total"], indirect=True)
def test_edits_that_bring_an_internal_variable(make_simulation, tmp_path, formulation):
    """A law that flows from the second frame on: the state has then what it had not at the start."""
    from gaussian_swaying.simulation.edits import Edit

    def make():
        return make_simulation(formulation="updated", parts={"edits": [Edit(time=0.04, law=Snow())]})

    recorder = Recorder(images=False, video=False)
    make().run(tmp_path / "run", 3, progress=False, recorder=recorder)
    held = read_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert held["state"]["internal"] is not None
    make().run(tmp_path / "run", 4, resume=True, progress=False, recorder=recorder)


def test_the_lines_of_a_log_are_made_once():
    """Numbers come back to the last bit, and so does what is not finite."""
    log, known = [{"a": 1, "b": 0.1}], []
    first = log_lines(log, known)
    log += [{"a": 2, "b": math.inf}]
    log[0]["b"] = 7.0  # its line is known
    assert log_lines(log, known) == known
    assert len(first) == 1
    assert [json.loads(line) for line in known] == [{"a": 1, "b": 0.1}, {"a": 2, "b": math.inf}]


def test_a_seal(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"content")
    with pytest.raises(ValueError, match="no checksum"):
        check_seal(file)
    seal(file)
    check_seal(file)
    assert file.read_bytes().startswith(b"content\ngaussian_swaying sha256 ")
    file.write_bytes(file.read_bytes().replace(b"content", b"context"))
    with pytest.raises(ValueError, match="damaged"):
        check_seal(file)
    with pytest.raises(ValueError, match="is a folder"):
        check_seal(tmp_path)
    with pytest.raises(FileNotFoundError):
        check_seal(tmp_path / "nothing")
