import zipfile

import numpy as np
import pytest
import torch
from shared import value_error

from gaussian_swaying.gaussians.parts import Part, PartRegion, Parts

PARTS = [
    Part("pot", "still"),
    Part("soil", "held", E=2e6),
    Part("leaf", density=300.0, thickness=0.002, nu=0.4, damping_ratio=0.1),
]


def test_the_file_keeps_labels_roles_and_materials(tmp_path):
    parts = Parts([0, 2, 1, 2, 2], PARTS)
    read = Parts.load(parts.save(tmp_path / "parts.npz"))
    assert read.parts == parts.parts
    assert torch.equal(read.labels, parts.labels)
    assert np.load(tmp_path / "parts.npz")["labels"].dtype == np.uint8
    assert read.mask("leaf").tolist() == [False, True, False, True, True]
    assert read.mask(role="held").tolist() == [False, False, True, False, False]
    many = Parts(torch.arange(300), [Part(f"leaf {k}") for k in range(300)])
    path = many.save(tmp_path / "many.npz")
    assert np.load(path)["labels"].dtype == np.uint16
    assert torch.equal(Parts.load(path).labels, torch.arange(300))
    assert repr(read) == "Parts(pot (still): 1, soil (held): 1, leaf (soft): 3)"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Part("a", "liquid"), "role of the part 'a'"),
        (lambda: Part("a", "rigid", E=1e5), "rigid and does not bend"),
        (lambda: Part("a", "rigid", nu=0.2), "rigid and does not bend"),
        (lambda: Part("", "soft"), "has no name"),
        (lambda: Part("a" * 1_000_000), "^A part has a name of 1,000,000 letters: give it one of at most 100.$"),
        (lambda: Part("a", "still", E=1e5), "still and has no material"),
        (lambda: Part("a", density=0.0), "density of the part 'a'"),
        (lambda: Part("a", nu=0.5), "nu of the part 'a'"),
        (lambda: Parts([0, 3], PARTS), "labels from 0 to 2"),
        (lambda: Parts([-1, 0], PARTS), "labels from 0 to 2"),
        (lambda: Parts([0], [Part("a"), Part("a")]), "the name 'a'"),
        (lambda: Parts([0], []), "Expected from 1 to"),
        (lambda: Parts([0, 1], [Part("stem"), Part("leaf", attached="stalk")]), "attached to 'stalk', which is no"),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with value_error(message):
        make()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": np.int64(4)}, "for 4 Gaussians, but has 3 labels"),
        ({"labels": np.array([0.0, 1.0, 2.0])}, "array `labels` has a wrong shape or type"),
        ({"labels": np.array([0, 1, 7])}, "labels from 0 to 2"),
        ({"roles": np.array(["soft"])}, "array `roles`"),
        ({"roles": np.array(["soft", "liquid", "soft"])}, "role of the part"),
        ({"E": np.array([np.nan, -3.0, 1.0])}, "E of the part"),
        ({"names": np.array([b"a", b"b", b"c"])}, "array `names`"),
        ({"names": None}, "no array `names`"),
        (
            b"no zip",
            r"^\S*parts.npz is not a .npz file, or is incomplete \([a-zF ]*\); make the parts again.$",
        ),
        (1 << 60, "announces more than it contains: make the parts again"),
    ],
)
def test_a_file_that_does_not_fit_together_is_refused(change, message, tmp_path):
    path = Parts([0, 1, 2], PARTS).save(tmp_path / "parts.npz")
    if isinstance(change, bytes):
        path.write_bytes(change)
    elif isinstance(change, int):
        with zipfile.ZipFile(path, "w") as archive, archive.open("count.npy", "w") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": (change,)})
    else:
        arrays = dict(np.load(path)) | change
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    with value_error(message) as error:
        Parts.load(path)
    assert str(path) in str(error.value)


def test_the_region_of_a_part_is_what_is_nearest_to_it():
    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    region = PartRegion("left", means, torch.tensor([True, False, True]))
    assert region.contains(torch.tensor([[0.4, 0, 0], [0.6, 1, 0]]))[0]
    assert region.contains(means).tolist() == [True, False, True]  # also where two are at one place
    assert region.contains(torch.zeros(2, 3, 3)).shape == (2, 3)
    assert repr(region) == "of the part 'left'"


def test_the_file_keeps_what_a_part_is_attached_to(tmp_path):
    parts = Parts([0, 1, 1], [Part("stem"), Part("leaf", attached="stem")])
    again = Parts.load(parts.save(tmp_path / "parts.npz"))
    assert again.parts == parts.parts
    assert again.attached_to() == [None, 0]
    assert Parts([0], [Part("stem")]).attached_to() is None
