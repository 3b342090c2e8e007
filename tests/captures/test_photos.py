import pytest
from shared import value_error

from gaussian_swaying.captures.photos import Photos


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("a.png", "a.png"),
        ("./sub/a.png", "sub/a.png"),
        ("sub\\a.png", "sub/a.png"),
        ("sub\\a.png", "sub\\a.png"),
        (".\\sub\\a.png", "sub/a.png"),
        ("SUB/a.PNG", "Sub/A.png"),
        ("a.png", "a.jpg"),
        ("a.JPEG", "A.webp"),
        ("a", "a.png"),
        ("r_0.5", "r_0.5.png"),
        ("a.heic", "a.jpg"),
        ("a  b.png", "a  b.png"),
        ("a b.png", "a  b.png"),
        ("Stra\u00dfe \u00dc.png", "Stra\u00dfe U\u0308.png"),
        ("\u626b\u63cf.png", "\u626b\u63cf.png"),
        ("/home/me/scan/images/a.png", "images/a.png"),
        ("C:\\Users\\me\\scan\\images\\a.png", "images/a.jpg"),
        ("../scan/images/a.png", "images/a.png"),
        ("images/a.png", "a.png"),
    ],
)
def test_names(tmp_path, name, file):
    (tmp_path / file).parent.mkdir(exist_ok=True, parents=True)
    (tmp_path / file).write_bytes(b"")
    assert Photos(tmp_path).find(name) == tmp_path / file


@pytest.mark.parametrize("name", ["c.png", "aa.png", "sub/b.png", "a.1.png", "sub"])
def test_no_photo(tmp_path, name):
    (tmp_path / "sub").mkdir()
    for file in ("a.png", "a.2.png", "sub/c.png"):
        (tmp_path / file).write_bytes(b"")
    assert Photos(tmp_path).find(name) is None


def test_a_photo_in_a_format_that_can_be_read_comes_first(tmp_path):
    for file in ("a.heic", "a.jpg", "b.heic"):
        (tmp_path / file).write_bytes(b"")
    assert Photos(tmp_path).find("a.heic") == tmp_path / "a.jpg"
    assert Photos(tmp_path).find("b.heic") == tmp_path / "b.heic"


def test_a_name_that_fits_several_photos_is_refused(tmp_path):
    for file in ("a.png", "A.JPG"):
        (tmp_path / file).write_bytes(b"")
    assert Photos(tmp_path).find("a.png") == tmp_path / "a.png"
    with value_error(r"name a of a photo fits 2 files.*rename or remove all but one"):
        Photos(tmp_path).find("a")
