import pytest
from shared import value_error

from gaussian_swaying.config.parser import option
from gaussian_swaying.sweeps.plan import read_axis, runs_of


def _runs(axes, **more):
    return runs_of({name: read_axis(name, given) for name, given in axes.items()}, **more)


def test_lists_and_ranges_are_combined():
    runs = _runs({"wind.flow": [[4, 0, 0], [8, 0, 0]], "material.E": {"from": 1, "to": 9, "count": 3}})
    assert [run["wind.flow"][0] for run in runs] == [4, 4, 4, 8, 8, 8]
    assert [run["material.E"] for run in runs] == [1.0, 5.0, 9.0] * 2


def test_ranges_reach_both_ends():
    (first, *_, last) = read_axis("E", {"from": 0.1, "to": "7e3", "count": 6, "scale": "log"})
    assert (first, last) == (0.1, 7000.0)
    values = read_axis("E", {"from": 1, "to": 1000, "count": 4, "scale": "log"})
    assert values == [1.0, 10.0, 100.0, 1000.0]


def test_draws_do_not_depend_on_other_axes():
    draw = {"draw": "uniform", "low": 2, "high": 3}
    alone = [run["a"] for run in _runs({"a": draw}, draws=6, seed=5)]
    beside = [run["a"] for run in _runs({"b": {"draw": "integer", "low": 0, "high": 9}, "a": draw}, draws=6, seed=5)]
    assert alone == beside
    assert len(set(alone)) == 6
    assert all(2 <= value <= 3 for value in alone)
    assert alone != [run["a"] for run in _runs({"a": draw}, draws=6, seed=6)]


def test_draws_are_the_same_everywhere():
    """Recorded numbers: another Python or machine must not change a sweep."""
    axes = {
        "a": {"draw": "uniform", "low": 0, "high": 1},
        "b": {"draw": "log", "low": 1, "high": 1000},
        "c": {"draw": "integer", "low": 0, "high": 99},
        "d": {"draw": "choice", "of": ["x", "y", "z"]},
    }
    assert _runs(axes, draws=2, seed=1) == RECORDED


RECORDED = [
    {"a": 0.744085547735, "b": 1.13888542992, "c": 3, "d": "x"},
    {"a": 0.87424432567, "b": 903.798950856, "c": 39, "d": "x"},
]


def test_each_combination_is_drawn():
    runs = _runs({"a": [1, 2], "b": {"draw": "integer", "low": 0, "high": 10**9}}, draws=3)
    assert [run["a"] for run in runs] == [1, 1, 1, 2, 2, 2]
    assert len({run["b"] for run in runs}) == 6


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], ("axes.E", "empty")),
        (3.0, ("axes.E", "[3.0]")),
        ({"from": 1, "to": 2}, ("axes.E.count", "whole number")),
        ({"from": 1, "to": 2, "count": 1}, ("axes.E.count", "at least 2")),
        ({"from": "much", "to": 2, "count": 3}, ("axes.E.from", "'much'")),
        ({"from": 1, "to": float("inf"), "count": 3}, ("axes.E.to", "finite")),
        ({"from": -1, "to": 2, "count": 3, "scale": "log"}, ("axes.E.from", "scale: linear")),
        ({"from": 1, "to": 2, "count": 3, "scale": "cubic"}, ("axes.E.scale", "linear, log")),
        ({"from": 1, "to": 2, "steps": 3}, ("axes.E", "`steps`", "count")),
        ({"draw": "normal", "low": 1}, ("axes.E.draw", "uniform")),
        ({"draw": "uniform", "low": 3, "high": 1}, ("axes.E.low", "exchange")),
        ({"draw": "integer", "low": 1.5, "high": 3}, ("axes.E.low", "whole number")),
        ({"draw": "log", "low": 0, "high": 3}, ("axes.E.low", "draw: uniform")),
        ({"draw": "choice", "of": []}, ("axes.E.of",)),
        ({"draw": "choice", "of": [1], "low": 1}, ("axes.E", "`low`")),
    ],
)
def test_bad_axes(given, words):
    with value_error("axes") as error:
        read_axis("E", given)
    for word in words:
        assert word in str(error.value)


def test_too_many_runs_and_nothing_to_draw():
    with value_error("1,000,000 runs"):
        _runs({name: list(range(100)) for name in "abc"})
    with value_error("set `draws` to 1"):
        _runs({"a": [1, 2]}, draws=3)


def test_options():
    assert option("material.law", "Sand") == "--material.law=Sand"
    assert option("recorder.video", False) == "--recorder.video=false"
