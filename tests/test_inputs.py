import os
import struct
import zipfile

import numpy as np
import pytest
from shared import png

from gaussian_swaying._inputs import check_archive, check_regular, read_json
from gaussian_swaying.captures.images import image_size


def test_a_pipe_and_a_device_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(ValueError, match=r"not a regular file; save the splat to a file first"):
            check_regular(path, "the splat")
    with pytest.raises(ValueError, match="is a directory; give the splat inside it"):
        check_regular(tmp_path, "the splat")
    with pytest.raises(FileNotFoundError, match="does not exist; check the path of the splat"):
        check_regular(tmp_path / "none", "the splat")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        check_regular("/dev/null/below", "the splat")
    (tmp_path / "file").write_bytes(b"12345")
    assert check_regular(tmp_path / "file", largest=5) == tmp_path / "file"
    with pytest.raises(ValueError, match="has 5 bytes, more than the 4"):
        check_regular(tmp_path / "file", largest=4)


def test_links_are_followed(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    for name, target in (("good", "file"), ("nowhere", "none"), ("round", "round")):
        (tmp_path / name).symlink_to(tmp_path / target)
    assert check_regular(tmp_path / "good", largest=5) == tmp_path / "good"
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        check_regular(tmp_path / "nowhere")
    with pytest.raises(OSError, match="round"):
        check_regular(tmp_path / "round")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[" * 200_000, "nested too deeply"),
        (b'{"a":' * 100_000, "nested too deeply"),
        (b'{"w": ' + b"9" * 400 + b"}", "whole number of 400 digits"),
        ('{"name": "Blüte"}'.encode("latin-1"), "not valid JSON"),
        (b"{", "not valid JSON"),
        (b"[" + b"[]," * 3_000_000 + b"0]", "has 6,000,001 entries, more than the 4,194,304"),
    ],
    ids=["list", "dict", "digits", "latin-1", "cut", "entries"],
)
def test_bad_json_is_one_sentence(text, words, tmp_path):
    (tmp_path / "cameras.json").write_bytes(text)
    with pytest.raises(ValueError, match=words) as error:
        read_json(tmp_path / "cameras.json", "camera file")
    assert "cameras.json" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_good_json(encoding, tmp_path):
    (tmp_path / "good.json").write_text('{"a": [1, 2.5, -3], "b": "ü"}', encoding=encoding)
    assert read_json(tmp_path / "good.json", "file") == {"a": [1, 2.5, -3], "b": "ü"}


def test_an_archive_that_swells_is_refused(tmp_path):
    good, bad = tmp_path / "good.npz", tmp_path / "bad.npz"
    np.savez(good, a=np.zeros(10))
    assert check_archive(good, "the run") == good
    with zipfile.ZipFile(bad, "w") as archive:
        archive.writestr("a.npy", b"12")
    data = bad.read_bytes()
    size = struct.pack("<I", 2)
    bad.write_bytes(data[:-60].replace(size + size, struct.pack("<II", 2, 0x7FFFFFFF)) + data[-60:].replace(
        size + size, struct.pack("<II", 2, 0x7FFFFFFF)))  # fmt: skip
    with pytest.raises(ValueError, match=r"2,147,483,647 bytes, far more than its size"):
        check_archive(bad, "the run")
    bad.write_bytes(b"PK not quite")
    with pytest.raises(ValueError, match=r"not a .npz file, or is incomplete"):
        check_archive(bad, "the run")


def test_a_picture_that_swells_is_refused(tmp_path):
    """A header of 60,000 x 60,000 pixels in a hundred bytes."""
    path = tmp_path / "photo.png"
    for side in (60_000, 10_000):
        path.write_bytes(png(side, side))
        with pytest.raises(ValueError, match=r"photo.png"):
            image_size(path)
    path.write_bytes(png(400, 300))
    assert image_size(path) == (400, 300)
