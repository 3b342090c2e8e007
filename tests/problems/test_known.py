"""Exact solutions and published numbers: the table is ``tools/bench/known.py``."""

import pytest
from bench.known import KNOWN, plain
from bench.runner import read

COARSE = [(one, run) for one in KNOWN for run in one.coarse]
RECORDED = {str(run.parameters): run for run in read("known") if "CPU" in run.device}
FINE = [
    (one, run, RECORDED[key])
    for one in KNOWN
    for run in one.fine
    if (key := str({"problem": one.name} | plain(run))) in RECORDED
    and getattr(RECORDED[key], "wall_s", 60.0) < 60  # s; the others are for the study alone
]


def _name(one, run):
    return ", ".join([one.name.split(":")[0], *(str(value) for value in run.values() if not isinstance(value, dict))])


@pytest.mark.parametrize(("one", "run"), COARSE, ids=[_name(*each) for each in COARSE])
def test_a_known_answer_on_a_coarse_grid(one, run):
    assert one.missed(run | one.measure(**run), one.goal | one.loose) == []


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("one", "run", "recorded"), FINE, ids=[_name(one, run) for one, run, _ in FINE])
def test_a_known_answer_on_a_fine_grid(one, run, recorded):
    found = one.verdicts(run | one.measure(**run), one.goal)
    before = one.verdicts(run | vars(recorded), one.goal)

    def off(value, low, high):
        return max(low - value, value - high, 0.0)

    worse = {name: (off(*found[name]), off(*before[name])) for name in found if off(*found[name])}
    assert {name: pair for name, pair in worse.items() if pair[0] > 1.1 * pair[1]} == {}
