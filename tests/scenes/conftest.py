import math

import pytest


def _leaf_area(length, width, taper=(0.55, 0.85)):
    """Area of the flat outline of a leaf [m²], from the beta function."""
    p, q = taper
    top = (p / (p + q)) ** p * (q / (p + q)) ** q
    return length * width / top * math.exp(math.lgamma(p + 1) + math.lgamma(q + 1) - math.lgamma(p + q + 2))


@pytest.fixture
def leaf_area():
    return _leaf_area
