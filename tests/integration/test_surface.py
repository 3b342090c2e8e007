"""The public surface: the names at the root."""

import inspect

import gaussian_swaying

FREE = {"SplatTrainer", "SineSway", "GaussianCloud", "MaterialPoints", "Frame", "WindForce"}
"""Those whose third argument is not an option but a part of what they are."""


def test_options_after_the_first_two_are_keyword_only():
    """So that another option can be added, and a call says what it sets."""
    loose = []
    for name in gaussian_swaying.__all__:
        given = list(inspect.signature(getattr(gaussian_swaying, name)).parameters.values())
        free = [part for part in given if part.kind is part.POSITIONAL_OR_KEYWORD]
        loose += [f"{name}({part.name})" for part in free[2:] if part.default is not part.empty and name not in FREE]
    assert loose == [], "put a `*` before these arguments"
