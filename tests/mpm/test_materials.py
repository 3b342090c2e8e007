import math

from shared import value_error

from gaussian_swaying.mpm.materials import MATERIALS, known_material, name_of

CLOTHS = ["cotton", "silk", "denim", "canvas", "fabric", "clothes"]
PLANTS = ["grass", "leaf", "succulent", "stem", "twig", "bark"]
NAMES = [*CLOTHS, "leather", "rubber", "paper", "cardboard", *PLANTS, "wood", "metal", "stone"]


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
    succulent = known_material("succulent")
    assert 0.9 < succulent.density * succulent.thickness < 10


def test_the_kinds_of_thing_have_the_mass_and_stiffness_of_their_sizes():
    """kg/m² of sheets; the bending stiffness of corrugated board, 5 to 15 N m; green wood is heavier than dry wood."""
    for name, low, high in (
        ("leaf", 0.15, 0.3),
        ("fabric", 0.1, 0.35),
        ("clothes", 0.14, 0.35),
        ("cardboard", 0.4, 0.6),
    ):
        known = known_material(name)
        assert low <= known.density * known.thickness <= high
    leaf, board = known_material("leaf"), known_material("cardboard")
    assert math.isclose(leaf.density * leaf.thickness, 0.2)
    assert 5 <= board.E * board.thickness**3 / (12 * (1 - board.nu**2)) <= 15
    assert 900 <= known_material("stem").density <= 1000
    assert 1e8 <= known_material("stem").E <= 1e9
    stiffness = [known_material(name).E for name in ("succulent", "leaf", "stem", "twig", "wood", "stone", "metal")]
    assert stiffness == sorted(stiffness)


def test_damping_is_that_of_a_sway_at_1_hz():
    """Motion that decays at a rate d has the damping ratio d / (2 omega)."""
    for known in MATERIALS.values():
        assert math.isclose(known.damping / (2 * 2 * math.pi), known.damping_ratio, rel_tol=0.05)


def test_an_unknown_name_lists_the_names():
    with value_error(f"Expected `material` to be one of {', '.join(NAMES)}, but got 'coton'"):
        known_material("coton")
