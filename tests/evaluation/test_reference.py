import json

import numpy as np
import pytest
import torch
from shared import value_error

from gaussian_swaying.evaluation.reference import read_cloth


def test_a_cloth_is_read(make_reference):
    cloth = read_cloth(make_reference(side=2.0) / "cloth.npz")
    assert cloth.positions.shape == (4, 17 * 9, 3)
    assert cloth.positions.dtype == torch.float32
    assert cloth.side == 2.0


def test_squares_are_halved_and_the_side_may_be_in_the_settings(make_reference):
    squares = np.array([[0, 9, 10, 1]])
    cloth = read_cloth(make_reference(faces=squares, settings=json.dumps({"width": 1.0, "height": 2.5})) / "cloth.npz")
    assert cloth.side == 2.5
    assert cloth.faces.tolist() == [[0, 9, 10], [0, 10, 1]]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"positions": np.zeros((4, 5, 2))}, r"Expected `positions` of .*cloth\.npz of shape \(T, V, 3\)"),
        ({"faces": np.zeros((4, 5), int)}, r"Expected `faces` of .*cloth\.npz of shape \(F, 3\)"),
        ({"faces": np.array([[0, 1, 999]])}, r"indices from 0 to 152"),
        ({"positions": np.full((4, 9, 3), np.nan), "faces": np.array([[0, 1, 2]])}, "to be finite"),
        ({"side": -1.0}, "to be positive"),
    ],
)
def test_a_bad_cloth(make_reference, arrays, message):
    with value_error(message):
        read_cloth(make_reference(**arrays) / "cloth.npz")


def test_a_damaged_or_incomplete_cloth(tmp_path):
    path = tmp_path / "cloth.npz"
    with value_error(r"cloth\.npz does not exist"):
        read_cloth(path)
    path.write_bytes(b"PK")
    with value_error(r"cloth\.npz is not a .npz file"):
        read_cloth(path)
    np.savez(path, positions=np.zeros((2, 3, 3)))
    with value_error("has no array `faces`"):
        read_cloth(path)
