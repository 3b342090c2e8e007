import json
import math

import pytest
from shared import rows

from gaussian_swaying._files import atomic, check_page, write_json, write_table


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})

    def fail_half_way():
        with atomic(path) as temporary:
            temporary.write_text("{")
            assert temporary.parent == path.parent  # a rename across file systems is not atomic
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail_half_way()
    with pytest.raises(IsADirectoryError) as caught, atomic(tmp_path) as temporary:
        temporary.write_text("{")
    assert caught.value.filename == str(tmp_path)
    assert json.loads(path.read_text()) == {"a": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["value.json"]


def test_numbers_that_json_does_not_have_are_null(tmp_path):
    write_json(tmp_path / "a.json", {"a": [math.nan, -math.inf, 1.5, None], "b": (1, "x"), "c": {"d": math.inf}})
    held = json.loads((tmp_path / "a.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert held == {"a": [None, None, 1.5, None], "b": [1, "x"], "c": {"d": None}}


def test_rows_of_an_older_run_leave_their_gaps(tmp_path):
    write_table(tmp_path / "table.csv", [{"a": 1}, {"a": 2, "b": 3}])
    assert rows(tmp_path / "table.csv") == [{"a": "1", "b": ""}, {"a": "2", "b": "3"}]


def test_a_page_needs_its_name_and_a_folder(tmp_path):
    check_page(tmp_path / "film.html", "film")
    for name, told in {
        "film.txt": "end in .html",
        "no/film.html": "The folder .*no of the film does not exist: make it",
    }.items():
        with pytest.raises(ValueError, match=told):
            check_page(tmp_path / name, "film")
