"""What the gate leaves to the nightly run has a small twin in the gate."""

from types import SimpleNamespace

import pytest
from nightly import without_a_twin


def test_what_is_slow_has_a_twin_in_the_gate(request):
    """Of the tests that were collected together with this one."""
    assert without_a_twin([item for item in request.session.items if isinstance(item, pytest.Function)]) == []


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
    ],
)
def test_a_twin_runs_in_the_gate(given, alone):
    """On a GPU slow tests of the interpreter are quick, so a test that needs one is no twin."""

    def item(name, mark):
        name, _, parameters = name.removesuffix("]").partition("[")
        marks = {"gpu": mark} if mark == "gpu" else {} if mark is None else {"slow": SimpleNamespace(kwargs=mark)}
        more = {"callspec": SimpleNamespace(id=parameters)} if parameters else {}
        return SimpleNamespace(originalname=name, get_closest_marker=marks.get, **more)

    assert without_a_twin([item(*each) for each in given]) == alone
