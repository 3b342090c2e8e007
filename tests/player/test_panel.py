import pytest
import yaml
from browsers import until
from shared import value_error

from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.player import session as session_module
from gaussian_swaying.player.panel import KINDS, OWN, Panel, slider
from gaussian_swaying.simulation.model import number

from .conftest import in_turn


@pytest.fixture
def panel(session):
    session.pause()
    session.start()
    return Panel(session)


def _set(panel, name, value=None):
    """Use a control, and wait until the session has taken it."""
    panel.set(name, value)
    in_turn(panel.session)
    assert panel.session.problem is None


def _value(panel, name):
    return panel.names()[name]["value"]


def _modulations(panel):
    there = yaml.safe_load(panel.session.yaml())["wind"]["modulations"]
    return [(one["class_path"].rsplit(".", 1)[-1], one["init_args"]) for one in there]


def test_every_number_of_the_model_that_a_scene_keeps_has_a_control(panel):
    model, controls = panel.session.simulation.model, panel.names()
    for name in model.numbers():
        known = number(name)
        if known.kind != "number" or not known.same_points or name == "frame_dt":
            continue
        control = controls[name]
        assert control["unit"] == known.unit
        assert control["value"] == pytest.approx(model.value(name), abs=1e-3)
        assert control["low"] <= control["value"] <= control["high"]
    assert (controls["material.E"]["log"], controls["material.nu"]["log"]) == (True, False)


def test_a_slider_reaches_two_decades_to_both_sides():
    ends = slider("aero.C_D", 1.2)
    assert (ends["low"], ends["high"]) == pytest.approx((0.012, 120.0))
    assert slider("aero.C_D", 0.0)["kind"] == "number"  # it has no logarithm


def test_the_wind_has_speed_and_angles_and_a_calm_keeps_its_direction(panel):
    session = panel.session
    assert _value(panel, "wind.speed") == pytest.approx(6.18, abs=0.01)
    before = _value(panel, "wind.azimuth")
    _set(panel, "wind.speed", 0.0)
    assert session.settings.wind.flow == [0.0, 0.0, 0.0]
    assert _value(panel, "wind.azimuth") == before
    _set(panel, "wind.speed", 3.0)
    assert _value(panel, "wind.azimuth") == pytest.approx(before, abs=0.01)
    _set(panel, "wind.flow", [0.0, 2.0, 0.0])
    assert _value(panel, "wind.azimuth") == 90.0
    assert session.simulation.wind.flows[0].tolist() == [0.0, 2.0, 0.0]


def test_modulations_are_edited_added_and_removed(panel, monkeypatch):
    monkeypatch.setattr(session_module, "ONE_CHANGE", 0.0)  # each is undone on its own, however fast they follow
    session = panel.session
    there = _modulations(panel)
    assert [kind for kind, _ in there] == ["SineSway", "GaussianGust"]
    for place, (_, arguments) in enumerate(there):
        for field, value in arguments.items():
            assert _value(panel, f"wind.modulations.{place}.{field}") == value
    _set(panel, "wind.modulations.0.period", 3.0)
    assert session.simulation.wind.modulations[0].period == 3.0
    assert session.simulation.wind.modulations[1].std == there[1][1]["std"]
    _set(panel, "add", "gusts")
    assert [kind for kind, _ in _modulations(panel)] == ["SineSway", "GaussianGust", KINDS["gusts"]]
    _set(panel, "wind.modulations.2.delta", 0.7)
    assert session.simulation.wind.modulations[2].delta == 0.7
    _set(panel, "remove.0")
    assert [kind for kind, _ in _modulations(panel)] == ["GaussianGust", "UniformGust"]
    session.undo()
    until(lambda: len(_modulations(panel)) == 3)
    assert _value(panel, "wind.modulations.0.period") == 3.0


def _tracks(panel):
    control = panel.names()["wind.schedule"]
    assert [track["name"] for track in control["tracks"]] == list(control["value"]["keys"])
    return control["value"]["keys"]


def test_the_timeline_keeps_what_it_does_not_show(panel):
    session = panel.session
    assert _tracks(panel) == {"speed": [], "azimuth": [], "gusts": []}
    session.change({"wind.schedule": [{"time": 0.0, "flow": [1.0, 0.0, 1.0]}]})
    in_turn(session)
    _set(panel, "wind.schedule", {"keys": {"gusts": [[0.0, 2.0], [1.0, 0.5]]}})
    keys = session.settings.wind.schedule
    assert [(key.time, key.flow, key.gusts) for key in keys] == [(0.0, [1.0, 0.0, 1.0], 2.0), (1.0, None, 0.5)]
    assert session.settings.wind.interpolation == "step"  # as it was
    before = _value(panel, "wind.azimuth")
    _set(panel, "wind.flow", [0.0, 0.0, 0.0])  # a steady wind leaves the gusts
    assert _tracks(panel) == {"speed": [], "azimuth": [], "gusts": [[0.0, 2.0], [1.0, 0.5]]}
    _set(panel, "wind.schedule", {"keys": _tracks(panel) | {"speed": [[3.0, 4.0]]}})
    assert _tracks(panel)["azimuth"] == [[3.0, before]]  # a calm has no direction of its own
    panel.set("wind.schedule", {"keys": {"speed": [], "azimuth": [[1.0, 9.0]], "gusts": []}})
    in_turn(session)
    assert "No key of `schedule` gives `speed`, and `flow` is zero" in session.problem
    assert len(_tracks(panel)["speed"]) == 1


def test_a_known_material_is_taken_but_for_its_thickness(panel):
    session, rubber = panel.session, MATERIALS["rubber"]
    assert _value(panel, "material") == OWN
    before, thickness = session.simulation, session.settings.material.thickness
    _set(panel, "material", "rubber")
    material = session.settings.material
    assert (material.E, material.nu, material.density) == (rubber.E, rubber.nu, rubber.density)
    assert (material.thickness, session.settings.solver.damping) == (thickness, rubber.damping)
    assert session.simulation is before
    assert session.changes == 1
    assert _value(panel, "material") == "rubber"
    _set(panel, "material.E", 3e4)
    assert _value(panel, "material") == OWN
    panel.set("material", OWN)  # the entry that says so changes nothing
    assert session.changes == 2


def test_gravity_grid_pins_and_light(panel):
    session = panel.session
    _set(panel, "gravity", 1.6)
    assert session.settings.solver.gravity == [0.0, 0.0, -1.6]
    assert panel.names()["grid"]["options"] == ["coarse", "normal", "fine"]
    _set(panel, "grid", "coarse")
    assert session.simulation.solver.dx == pytest.approx(0.15)
    assert _value(panel, "grid") == "coarse"
    _set(panel, "free")
    assert session.settings.solver.boundaries == []
    _set(panel, "light", 90.0)
    x, y, _ = session.settings.shader.init_args.light
    assert x == pytest.approx(0.0, abs=1e-3)
    assert y > 0.1
    _set(panel, "shading", False)
    assert session.simulation.painter.shader is None
    _set(panel, "shading", True)
    assert _value(panel, "light") == 90.0


def test_the_grid_of_the_start_is_refined_up_to_the_configured_one(panel):
    session = panel.session
    session.configured_dx = 0.08
    assert panel.names()["grid"]["options"] == ["coarse", "normal", "fine", "configured"]
    _set(panel, "grid", "configured")
    assert session.simulation.solver.dx == 0.08
    _set(panel, "grid", "fine")
    assert session.simulation.solver.dx == pytest.approx(0.07)  # of the start's


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("scene.ply", "/etc/passwd", "no control 'scene.ply'"),
        ("wind.modulations.0.class_path", "os.system", "no control"),
        ("wind.modulations.7.period", 1.0, "no control"),
        ("grid", "huge", "Expected grid to be one of coarse"),
        ("material.E", -3.0, "material.E"),
        ("material.nu", float("nan"), "material.nu"),
        ("wind.speed", 1e9, "wind.speed"),
    ],
)
def test_what_is_no_control_or_no_value_is_refused(panel, name, value, told):
    before = panel.session.settings
    with value_error(told):
        panel.set(name, value)
    assert panel.session.settings is before


def test_legends_follow_the_wind(panel):
    assert panel.legends()["force"]["high"] == panel.session.simulation.stepper.force_scale()
    _set(panel, "wind.speed", 20.0)
    assert panel.legends()["wind"]["high"] == pytest.approx(30.0, abs=1e-3)  # 1.5 times the flow
