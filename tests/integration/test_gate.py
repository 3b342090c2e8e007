"""Every module has its tests, and what the gate leaves to the nightly run has a small twin in the gate."""

import ast
from pathlib import Path
from types import SimpleNamespace

import pytest
from nightly import without_a_twin

TESTS = Path(__file__).parents[1]
PACKAGE = TESTS.parent / "gaussian_swaying"


def test_what_is_slow_has_a_twin_in_the_gate(request):
    if not any(TESTS.is_relative_to(Path(given.partition("::")[0]).resolve()) for given in request.config.args):
        pytest.skip("needs all tests")  # twins may be in other files
    alone = without_a_twin([item for item in request.session.items if isinstance(item, pytest.Function)])
    assert alone == [], "these need a small test in the gate: `pytest.mark.slow(twin=...)` names it (tests/nightly.py)"


@pytest.mark.parametrize(
    ("given", "alone"),
    [
        ([("series[large]", {}), ("series[small]", None)], []),
        ([("series[large]", {"gate": ["small"]}), ("series[small]", {"gate": ["small"]})], []),
        ([("series[large]", {"gate": ["tiny"]}), ("series[small]", {"gate": ["tiny"]})], ["series", "series[tiny]"]),
        ([("series[large]", {}), ("series[cuda]", "gpu")], ["series"]),
        ([("whole", {})], ["whole"]),
        ([("whole", {"twin": "sample"}), ("sample", None)], []),
        ([("whole", {"twin": "sample"}), ("sample", {})], ["whole", "sample"]),
        ([("whole", {"twin": "sample"})], ["whole"]),
        ([("whole", {}), ("whole", None, "elsewhere.py")], ["whole"]),
        ([("whole", {"twin": "sample"}), ("sample", None, "elsewhere.py")], []),
    ],
)
def test_a_twin_runs_in_the_gate(given, alone):
    """A test that needs a GPU runs nowhere else, so it is no twin."""

    def item(name, mark, path="here.py"):
        name, _, parameters = name.removesuffix("]").partition("[")
        marks = {"gpu": mark} if mark == "gpu" else {} if mark is None else {"slow": SimpleNamespace(kwargs=mark)}
        more = {"callspec": SimpleNamespace(id=parameters)} if parameters else {}
        return SimpleNamespace(path=path, originalname=name, get_closest_marker=marks.get, **more)

    assert without_a_twin([item(*each) for each in given]) == alone


def test_every_module_has_a_test_file_of_its_name_or_is_named_in_the_one_that_covers_it():
    """`tests/mpm/test_guard.py` is that of `mpm/guard.py`; others are in a line `Covers: mpm.body` of one."""
    named = [name for path in TESTS.rglob("test_*.py") for name in _covered(path)]
    modules = {path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py")}
    modules = {".".join(path.parts): path for path in modules if path.name != "__init__"}
    own = [
        name for name, path in modules.items() if (TESTS / path.parent / f"test_{path.name.lstrip('_')}.py").exists()
    ]
    assert len(own) > 100
    missing = sorted(set(modules) - {*own, *named})
    assert missing == [], "room.name needs tests/room/test_name.py, or `Covers: room.name.` in another file's docstring"
    assert sorted(set(named) - set(modules)) == [], "`Covers:` names modules that were moved or are gone"


def _covered(path):
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    _, _, names = docstring.partition("\nCovers: ")
    return names.partition("\n\n")[0].rstrip(".").replace("\n", " ").replace(",", " ").split()
