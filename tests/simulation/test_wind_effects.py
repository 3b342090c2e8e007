import pytest
import torch
from shared import double, waits

from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.step import parts_of
from gaussian_swaying.wind.effects import Obstacle, Profile
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.tables import Shelter
from gaussian_swaying.wind.turbulence import Turbulence


def _wind():
    gusts = Turbulence(0.3, 0.5, cells=[16, 8, 8])
    return WindField([4.0, 1.0, 0.0], effects=[Profile([0, 0, -0.5], height=2.0), gusts, Shelter(8)])


def test_places_are_converted_once(make_simulation):
    """Scene units to metres from the object's centre; what was given stays as it was."""
    simulation = make_simulation(scene={"metres_per_unit": 2.0})
    given = WindField([4.0, 0.0, 0.0], effects=[Obstacle([1.0, 2.0, 3.0], [0.5] * 3), Profile([0.0, 0.0, -1.0])])
    simulation.wind = given
    frame = simulation.scene.frame
    expected = 2.0 * (double([1.0, 2.0, 3.0]) - frame.origin)
    for _ in range(2):
        sphere, profile = simulation.wind.effects
        assert sphere.center == pytest.approx(expected.tolist())
        assert list(sphere.radii) == [1.0] * 3
        assert profile.ground[2] == pytest.approx(2.0 * (-1.0 - float(frame.origin[2])))
        simulation.wind = simulation.wind
    assert list(given.effects[0].radii) == [0.5] * 3


def test_shelter_is_refreshed_in_every_frame(make_simulation):
    simulation = make_simulation()
    simulation.wind = WindField([4.0, 0.0, 0.0], effects=[Shelter(8)])
    tables, state = [], simulation.start()
    for _ in range(3):
        state, _ = simulation.advance(state)
        tables.append(simulation.wind.effects[0].table.clone())
    assert tables[0].min() < 0.99
    assert not torch.equal(tables[0], tables[2])


def test_every_effect_can_be_named_in_a_configuration(tmp_path):
    effects = [
        "{class_path: Profile, init_args: {height: 3.0}}",
        "{class_path: Profile, init_args: {exponent: 0.2}}",
        "{class_path: Turbulence, init_args: {cells: [8, 8, 8]}}",
        "{class_path: Obstacle, init_args: {center: [0, 0, 0], radii: [1.0, 1.0, 1.0]}}",
        "{class_path: Obstacle, init_args: {center: [0, 0, 0], radii: [1, 1, null]}}",
        "{class_path: Obstacle, init_args: {center: [0, 0, 0], radii: [1, 2, 3]}}",
        "{class_path: Shelter}",
    ]
    text = "scene: {generator: {class_path: FlagScene, init_args: {spacing: 0.1}}}\nsolver: {dx: 0.25}\n"
    text += "wind:\n  flow: [1, 0, 0]\n  effects:\n" + "".join(f"  - {effect}\n" for effect in effects)
    (tmp_path / "wind.yaml").write_text(text)
    simulation = Simulation.from_yaml(tmp_path / "wind.yaml", device="cpu")
    assert [type(effect).__name__ for effect in simulation.wind.effects] == [
        effect.split(": ")[1].split(",")[0].rstrip("}") for effect in effects
    ]
    state, _ = simulation.advance(simulation.start())
    assert torch.isfinite(state.position).all()


def test_the_next_frame_is_foreseen_in_its_own_shelter(make_simulation):
    simulation = make_simulation()
    simulation.wind = _wind()
    state, _ = simulation.advance(simulation.start())
    shelter, parts = simulation.wind.effects[2], parts_of(simulation.stepper)
    before = shelter.table.clone()
    foreseen = simulation.stepper.wind_force.foreseen(state).samples(state, 0.01, 5)
    assert torch.equal(shelter.table, before)
    simulation.stepper.wind_force.refresh(state)
    assert not torch.equal(shelter.table, before)
    assert torch.equal(simulation.stepper.wind_force.samples(state, 0.01, 5), foreseen)
    assert parts_of(simulation.stepper) == parts
    simulation.wind.effects[1].table.mul_(2.0)
    assert parts_of(simulation.stepper) != parts


@pytest.mark.gpu
@pytest.mark.parametrize("uniform", [True, False])
def test_the_host_waits_once_in_a_frame(make_simulation, uniform):
    simulation = make_simulation(wind=WindField([4.0, 1.0, 0.0]) if uniform else _wind()).to("cuda")
    state = simulation.start()  # only now is the solver bound to its kernels
    assert simulation.stepper.foresees
    for _ in range(3):
        state, _ = simulation.advance(state)
    assert waits(lambda: simulation.advance(state)) == 1
