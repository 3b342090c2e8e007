"""Checkpoints of a training that are damaged or something else are refused in one sentence."""

import random
import traceback

import pytest
import torch
from shared import value_error

from gaussian_swaying.training.checkpoints import PlainCheckpoints, read_training_checkpoint
from gaussian_swaying.training.densification import PARAMETERS

FIELDS = ("densification", "kind", "scene_scale", "sh_degree", "seed", "random", "seen")


def _held():
    state = {f"model.{name}": torch.randn(20, 3) for name in PARAMETERS}
    return {"state_dict": state, "splat_training": dict.fromkeys(FIELDS, 0), "global_step": 5}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "checkpoints" / "step.ckpt"
    PlainCheckpoints().save_checkpoint(_held(), str(path))
    return path


def _refused(file, case):
    with value_error(r"^[^\n]*step\.ckpt [^\n]*give another `--ckpt_path`\.$"):
        PlainCheckpoints().load_checkpoint(str(file))
    return case


def test_damaged_ones(file):
    content = file.read_bytes()
    assert read_training_checkpoint(file)["global_step"] == 5
    assert torch.load(file, weights_only=True)["global_step"] == 5  # for others it is as any
    for broken in (b"", b"hello", content[: len(content) // 2]):
        file.write_bytes(broken)
        _refused(file, "cut")
    file.unlink()
    _refused(file, "missing")


def test_something_else(file):
    def save(held):
        PlainCheckpoints().save_checkpoint(held, str(file))
        return file

    for name in FIELDS:
        held = _held()
        del held["splat_training"][name]
        _refused(save(held), name)
    for name in PARAMETERS:
        for wrong in (None, 3, torch.randn(19, 3), torch.randn(20, 3).double(), torch.full((20, 3), torch.nan)):
            held = _held()
            held["state_dict"][f"model.{name}"] = wrong
            _refused(save(held), name)
    for other in ([1], {}, {"splat_training": 3}, _held() | {"state_dict": None}):
        _refused(save(other), other)
    assert [path.name for path in file.parent.iterdir()] == ["step.ckpt"]


def test_no_advice_to_execute_the_code_in_a_file(file):
    """PyTorch's own message names the argument that would."""
    PlainCheckpoints().save_checkpoint(_held() | {"hyper_parameters": random.Random(0)}, str(file))
    with value_error(r"more than tensors, numbers and text, which is never loaded") as caught:
        PlainCheckpoints().load_checkpoint(str(file))
    assert "weights_only" not in "".join(traceback.format_exception(caught.value, limit=0))
