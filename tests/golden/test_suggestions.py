"""Suggestions for things made in code, some of them as captured, are what they were.

Rounding moves a Gaussian from one side of a threshold to the other, so counts may differ by half a percent, or by two;
other numbers by half a percent of the largest of their list. Numbers that follow from linear algebra or a search for a
typical stretch of wind may differ by 5 %, and that stretch is another one where two are equally typical. Seven changes
of the places by 1e-6 on an AMD EPYC make E of the biker, who is rigid, 12.0 to 15.7 GPa.
"""

import json

import pytest
from golden.suggestions import CASES, FILE, numbers_of

LOOSE = {"natural": 0.05, "youngs_modulus": 0.05, "thickness": 0.05, "drag": 0.05, "substeps": 0.1}
SENSITIVE = {"captured_biker.youngs_modulus": 0.25}


def check(found, expected, share, where):
    if isinstance(expected, dict):
        assert set(found) == set(expected), where
        for key, value in expected.items():
            check(found[key], value, SENSITIVE.get(f"{where}.{key}", LOOSE.get(key, share)), f"{where}.{key}")
    elif isinstance(expected, list) and not all(isinstance(value, (int, float)) for value in expected):
        assert len(found) == len(expected), where
        for k, value in enumerate(expected):
            check(found[k], value, share, f"{where}[{k}]")
    elif isinstance(expected, list):
        size = max(map(abs, expected), default=0)
        assert found == pytest.approx(expected, rel=share, abs=max(share * size, 2 * isinstance(size, int))), where
    elif isinstance(expected, (int, float)) and not isinstance(expected, bool):
        assert found == pytest.approx(expected, rel=share, abs=2 if isinstance(expected, int) else 1e-6), where
    else:
        assert found == expected, where


@pytest.mark.parametrize("name", CASES)
def test_it_is_suggested_as_before(name):
    found, expected = json.loads(json.dumps(numbers_of(name))), json.loads(FILE.read_text())[name]
    start, other = found.pop("start"), expected.pop("start")
    check(found, expected, 0.005, name)
    # it lies upwind or downwind of now
    assert abs(start[0] * other[1] - start[1] * other[0]) <= 0.02 * max(map(abs, start)) * max(map(abs, other))
