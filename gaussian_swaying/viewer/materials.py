"""Young's moduli of everyday materials, to give an idea of a stiffness."""

from __future__ import annotations

# From, in Pa, to the next one. Gels and muscle at rest: Levental, Georges & Janmey 2007, "Soft biological materials and
# their impact on cell function"; foam, rubber, cork, leather and plastics: Ashby 2011, "Materials Selection in
# Mechanical Design", chart of modulus and density. The limits are rounded to powers of ten.
MATERIALS = (
    (0.0, "soft jelly"),
    (1e3, "jelly"),
    (1e4, "muscle at rest"),
    (1e5, "soft foam"),
    (1e6, "rubber"),
    (1e7, "cork"),
    (1e8, "leather"),
    (1e9, "hard plastic"),
    (1e10, "metal or stone"),
)

_UNITS = ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa"), (0.0, "Pa"))


def like(stiffness: float) -> str:
    """The material whose Young's modulus [Pa] is nearest, in words."""
    return next(name for least, name in reversed(MATERIALS) if stiffness >= least)


def in_pascal(stiffness: float) -> str:
    """A modulus [Pa] with three digits and a unit, such as ``9 kPa``."""
    size, unit = next((size, unit) for size, unit in _UNITS if stiffness >= size)
    return f"{stiffness / (size or 1.0):.3g} {unit}"
