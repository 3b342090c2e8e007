"""What the gate leaves to the nightly run has a small twin in the gate."""

from types import SimpleNamespace

import pytest


def _without_a_twin(items):
    """Slow tests for which nothing runs in the gate: neither other parameters nor the twin that they name."""
    twins, gate = {}, set()
    for item in items:
        slow = item.get_closest_marker("slow")
        if slow is not None:
            twins.setdefault(item.originalname, slow.kwargs.get("twin"))
        elif item.get_closest_marker("gpu") is None:
            gate.add(item.originalname)
    return [name for name, twin in twins.items() if not {name, twin} & gate]


def test_what_is_slow_has_a_twin_in_the_gate(request):
    """Of the tests that were collected together with this one."""
    assert _without_a_twin([item for item in request.session.items if isinstance(item, pytest.Function)]) == []


@pytest.mark.parametrize(
    ("given", "alone"),
    [
        ([("series", "slow"), ("series", None)], []),
        ([("series", "slow"), ("series", "gpu")], ["series"]),
        ([("whole", "slow")], ["whole"]),
        ([("whole", "slow", "sample"), ("sample", None)], []),
        ([("whole", "slow", "sample"), ("sample", "slow")], ["whole", "sample"]),
        ([("whole", "slow", "sample")], ["whole"]),
    ],
)
def test_a_twin_runs_in_the_gate(given, alone):
    """On a GPU slow tests of the interpreter are quick, so a test that needs one is no twin."""

    def item(name, mark, twin=None):
        marks = {} if mark is None else {mark: SimpleNamespace(kwargs={} if twin is None else {"twin": twin})}
        return SimpleNamespace(originalname=name, get_closest_marker=marks.get)

    assert _without_a_twin([item(*each) for each in given]) == alone
