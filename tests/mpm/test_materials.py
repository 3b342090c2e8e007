"""Materials by name: their table, and the one of the docs."""

import math
from pathlib import Path

import pytest

from gaussian_swaying.mpm.materials import MATERIALS, known_material, name_of

DOCS = Path(__file__).resolve().parents[2] / "docs" / "configuration.md"
NAMES = ["cotton", "silk", "denim", "canvas", "leather", "rubber", "paper", "grass", "leaf", "twig", "wood"]


def rows():
    """The table of the docs, as the code gives it."""
    lines = [
        "| name | `E` [Pa] | `nu` | `density` [kg/m³] | `thickness` [mm] | mass [kg/m²] | `solver.damping` [1/s] "
        "| waves [m/s] | read in a source |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, m in MATERIALS.items():
        numbers = (f"{m.E:.1e}", m.nu, f"{m.density:g}", f"{1e3 * m.thickness:g}", f"{m.density * m.thickness:.2g}")
        cells = (f"`{name}`", *numbers, f"{m.damping:g}", f"{m.wave_speed:.0f}", m.source or "-")
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def test_the_docs_have_the_table_of_the_code():
    assert "\n".join(rows()) in DOCS.read_text()


def test_all_are_there_and_told_apart():
    assert list(MATERIALS) == NAMES
    for name, known in MATERIALS.items():
        assert name_of(known.E, known.nu, known.density) == name
        assert known.estimated  # no material has all of its numbers from a source
        assert known.source or known.estimated.startswith("all")
        assert set(known.numbers) == {"E", "nu", "density", "thickness"}
    assert name_of(1e5, 0.3, 200.0) is None


def test_numbers_are_those_of_their_sources():
    denim, paper = known_material("denim"), known_material("paper")
    assert math.isclose(denim.density * denim.thickness, 0.324, rel_tol=1e-3)  # kg/m²
    stiffness = paper.E * paper.thickness**3 / (12 * (1 - paper.nu**2))
    assert math.isclose(stiffness, 1.315e-4, rel_tol=0.01)  # N m
    canvas, silk = known_material("canvas"), known_material("silk")
    assert math.isclose(canvas.density * canvas.thickness, 10 * 0.0283495 / 0.9144**2, rel_tol=0.01)
    assert math.isclose(silk.density * silk.thickness, 12 * 4.34e-3, rel_tol=0.01)
    assert 0.7e9 <= known_material("twig").E <= 4.6e9


def test_damping_is_that_of_a_sway_at_1_hz():
    """Motion that decays at a rate d has the damping ratio d / (2 omega)."""
    for known in MATERIALS.values():
        assert math.isclose(known.damping / (2 * 2 * math.pi), known.damping_ratio, rel_tol=0.05)


def test_an_unknown_name_lists_the_names():
    with pytest.raises(ValueError, match=f"Expected `material` to be one of {', '.join(NAMES)}, but got 'coton'"):
        known_material("coton")
