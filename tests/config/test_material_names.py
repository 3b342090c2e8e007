import pytest
from shared import refused, up_to, value_error

from gaussian_swaying.cli.simulate import main
from gaussian_swaying.config.material_names import with_material_option, with_named_materials
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material
from gaussian_swaying.simulation.simulation import Simulation

COTTON, LEAF = MATERIALS["cotton"], MATERIALS["leaf"]
SCENE = "scene: {generator: {class_path: FlagScene, init_args: {spacing: 0.1}}}\n"


@pytest.fixture
def read(tmp_path):
    def parse(*texts, options=()):
        arguments = []
        for k, text in enumerate(texts):
            path = tmp_path / f"{k}.yaml"
            path.write_text(text)
            arguments += ["--config", str(path)]
        return Simulation.parser().parse_args([*arguments, *options])

    return parse


def _numbers(material):
    return {name: getattr(material, name) for name in ("E", "nu", "density", "thickness")}


def test_a_name_stands_for_its_numbers(read):
    settings = read(SCENE + "material: cotton\n")
    assert _numbers(settings.material) == COTTON.numbers
    assert settings.solver.damping == COTTON.damping
    simulation = Simulation.from_settings(Simulation.parser(), settings)
    assert _numbers(simulation.material) == COTTON.numbers
    assert simulation.solver.damping == COTTON.damping
    assert float(simulation.scene.points.youngs_modulus[0]) == COTTON.E
    assert "cotton" not in simulation.config  # the numbers are there: they stay what they were


def test_numbers_beside_a_name_win(read):
    text = "material: {E: 5.0, name: cotton, thickness: 0.002}\nsolver: {dx: 0.1, damping: 3.0}\n"
    settings = read(text)
    assert _numbers(settings.material) == COTTON.numbers | {"E": 5.0, "thickness": 0.002}
    assert (settings.solver.dx, settings.solver.damping) == (0.1, 3.0)
    assert read("material: {E: 5.0}\n").material.density == 200.0


def test_what_comes_later_wins(read):
    settings = read("material: cotton\n", "material: {E: 7.0}\n", options=["--material.nu", "0.1"])
    assert _numbers(settings.material) == COTTON.numbers | {"E": 7.0, "nu": 0.1}
    for option in (["--material", "leaf"], ["--material=leaf"]):
        settings = read("material: {E: 7.0}\nsolver: {damping: 3.0}\n", options=[*option, "--material.nu", "0.1"])
        assert _numbers(settings.material) == LEAF.numbers | {"nu": 0.1}
        assert settings.solver.damping == LEAF.damping
    settings = read("material: cotton\n", options=["--material", '{"E": 4.0}'])
    assert _numbers(settings.material) == COTTON.numbers | {"E": 4.0}


def test_regions_have_names_too():
    part = {"region": {"class_path": "Everything"}, "name": "twig", "E": 3.0}
    found = with_named_materials({"material": {"name": "leaf", "regions": [part, {"nu": 0.2}]}})
    first, second = found["material"]["regions"]
    assert first == MATERIALS["twig"].numbers | {"region": part["region"], "E": 3.0}
    assert second == {"nu": 0.2}


@pytest.mark.parametrize(
    "given", [None, [], "material", {}, {"material": None}, {"material": {"E": 1.0}}, {"name": "cotton"}]
)
def test_everything_else_stays_as_it_is(given):
    assert with_named_materials(given) == given


def test_a_solver_of_ones_own_has_its_own_damping():
    found = with_named_materials({"material": "cotton", "custom_solver": {"class_path": "my.Solver"}})
    assert "solver" not in found
    assert with_material_option(["--material.E", "3", "--materials", "x"]) == ["--material.E", "3", "--materials", "x"]


def test_an_unknown_name_is_refused_with_the_names(tmp_path, capsys):
    path = tmp_path / "a.yaml"
    output = ["--output", str(tmp_path / "run")]
    for text in ("material: coton\n", "material: {name: coton}\n"):
        path.write_text(SCENE + text)
        refused(main, ["--config", str(path), *output], capsys, "`material`", "cotton, silk", "wood", "'coton'")
    refused(main, ["--config", "flag", "--material", "coton", *output], capsys, "`--material`", "cotton, silk", "wood")
    with value_error("`material` to be one of cotton, silk"):
        Simulation(FlagScene(spacing=0.1), "coton")


def test_in_python():
    hold = up_to(x=0.11)
    simulation = Simulation(FlagScene(spacing=0.1), "cotton", hold=hold, device="cpu")
    assert _numbers(simulation.material) == COTTON.numbers
    assert simulation.solver.damping == COTTON.damping
    given = Simulation(FlagScene(spacing=0.1), "cotton", solver=MPMSolver(0.2), device="cpu")
    assert given.solver.damping == 0.0
    own = Material.named("leaf", E=3.0)
    assert _numbers(own) == LEAF.numbers | {"E": 3.0}
    with value_error("cotton, silk"):
        Material.named("lef")
