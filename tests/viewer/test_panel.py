"""The panel of the live page: what its controls show and do, asked by a client and read from the session."""

import math
import uuid

import pytest
import yaml
from browsers import until

pytest.importorskip("viser", reason="needs the extra [viewer]")
from gaussian_swaying.gaussians.formats import export_cloud
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.viewer import session as session_module
from gaussian_swaying.viewer.controls import FEELS, OWN, Page, in_pascal, legend, like
from gaussian_swaying.viewer.session import Session


@pytest.fixture
def client(page, connect):
    return connect(page)


def _modulations(session):
    return [
        (m["class_path"].rsplit(".", 1)[-1], m["init_args"])
        for m in yaml.safe_load(session.yaml())["wind"]["modulations"]
    ]


def test_the_configuration_comes_back_and_changes_are_undone(page, client):
    """Pins and material too, and the controls show it."""
    session, controls = page.session, page.controls
    first = session.yaml()
    assert controls.undo.disabled
    client.set(controls.holding.free, True)
    until(lambda: session.settings.solver.boundaries == [])
    client.set(controls.stiffness, 5e5)
    until(lambda: session.settings.material.E == 5e5)
    client.set(controls.wind_speed, 1.0)
    until(lambda: session.changes == 3 and not controls.undo.disabled)
    client.set(controls.undo, True)
    until(lambda: controls.wind_speed.value == pytest.approx(6.2))
    assert controls.stiffness.value == 5e5
    client.set(controls.restore, True)
    until(lambda: session.yaml() == first)
    until(lambda: controls.stiffness.value == 9e3)
    assert len(session.simulation.solver.bound.boundaries) == 1
    held = controls.holding.places()
    assert len(held) > 5
    assert abs(held[:, 0]).max() < 0.03  # the pole

    def lit_from_the_side():
        client.set(controls.light, 90.0)  # again, if the controls were still being put back
        return session.settings.shader.init_args.light[0] == pytest.approx(0.0, abs=1e-3)

    until(lit_from_the_side)
    assert session.settings.shader.init_args.light[1] > 0.1


def test_modulations_that_are_there_are_shown_and_edited(page, client, monkeypatch):
    monkeypatch.setattr(session_module, "ONE_CHANGE", 0.0)  # each is undone on its own, however fast they follow
    session, gusts = page.session, page.controls.gusts
    there = _modulations(session)
    assert [kind for kind, _ in there] == ["SineSway", "GaussianGust"]
    assert gusts.folder.label == "Sway and gusts: sway, noise"
    shown = [{field: control.value for field, control in numbers.items()} for numbers in gusts.numbers]
    assert shown == [arguments for _, arguments in there]
    client.set(gusts.numbers[0]["period"], 3.0)
    until(lambda: _modulations(session)[0][1]["period"] == 3.0)
    assert session.simulation.wind.modulations[0].period == 3.0
    assert session.simulation.wind.modulations[1].std == there[1][1]["std"]
    period = gusts.numbers[0]["period"]
    client.set(gusts.add, "Gusts")
    until(lambda: len(gusts.numbers) == 3)
    assert gusts.folder.label == "Sway and gusts: sway, noise, gusts"
    assert [kind for kind, _ in _modulations(session)] == ["SineSway", "GaussianGust", "UniformGust"]
    assert period._impl.removed  # the list is drawn anew
    client.set(gusts.numbers[2]["delta"], 0.7)
    until(lambda: _modulations(session)[2][1].get("delta") == 0.7)
    assert session.simulation.wind.modulations[2].delta == 0.7
    client.set(gusts.removers[0], True)
    until(lambda: len(_modulations(session)) == len(gusts.numbers) == 2)
    assert [kind for kind, _ in _modulations(session)] == ["GaussianGust", "UniformGust"]
    assert session.problem is None
    session.undo()
    until(lambda: len(gusts.numbers) == 3)
    assert gusts.numbers[0]["period"].value == 3.0


def test_stiffness_is_in_pascal_on_a_logarithmic_slider(page, client):
    session, controls = page.session, page.controls
    assert controls.stiffness.value == 9e3
    assert controls.stiffness_log.value == (round(math.log10(9e3), 2),)
    assert controls.feels.content == "9 kPa: like jelly"
    client.set(controls.stiffness_log, [6.3])
    until(lambda: pytest.approx(10**6.3, rel=0.005) == session.settings.material.E)
    until(lambda: controls.feels.content == "2 MPa: like rubber")
    assert controls.stiffness.value == session.settings.material.E
    client.set(controls.stiffness, 3e4)
    until(lambda: controls.stiffness_log.value == (pytest.approx(math.log10(3e4), abs=0.005),))
    until(lambda: session.settings.material.E == 3e4)


def test_a_known_material_is_taken_but_for_its_thickness(page, client):
    """In motion, and in one change that can be undone."""
    session, controls = page.session, page.controls
    rubber = MATERIALS["rubber"]
    assert (controls.known.value, controls.kept.visible) == (OWN, False)
    assert controls.known.options == (OWN, *MATERIALS)
    before, thickness = session.simulation, session.settings.material.thickness
    client.set(controls.known, "rubber")
    until(lambda: session.changes == 1)
    material = session.settings.material
    assert (material.E, material.nu) == (rubber.E, rubber.nu)
    assert (material.density, material.thickness) == (rubber.density, thickness)
    assert session.settings.solver.damping == controls.damping.value == rubber.damping
    assert session.simulation is before
    until(lambda: controls.kept.visible and "rubber" in controls.kept.content)
    for words in (f"stays at {1e3 * thickness:g} mm", "rubber has 2 mm", "`--material rubber`"):
        assert words in controls.kept.content
    assert controls.stiffness.value == rubber.E
    client.set(controls.stiffness, 3e4)
    until(lambda: controls.known.value == OWN and not controls.kept.visible)
    client.set(controls.undo, True)
    until(lambda: controls.known.value == "rubber")
    client.set(controls.known, OWN)
    assert session.settings.material.E == rubber.E


def test_the_table_of_materials_has_no_gap():
    starts = [least for least, _ in FEELS]
    assert starts == sorted(set(starts))
    assert starts[0] == 0
    assert [like(least) for least, _ in FEELS] == [name for _, name in FEELS]
    assert [in_pascal(e) for e in (0.5, 999, 1e3, 2.5e6, 1e9)] == ["0.5 Pa", "999 Pa", "1 kPa", "2.5 MPa", "1 GPa"]


def test_wind_force_and_streaks_have_legends(page, client):
    controls = page.controls
    assert not controls.legends.visible
    client.set(controls.shown, "force")
    until(lambda: controls.legends.visible)
    assert legend("Force of the wind", "Pa", page.session.simulation.stepper.force_scale()) == controls.legends.content
    client.set(controls.shown, "wind")
    until(lambda: "Speed of the air [m/s]" in controls.legends.content and "Force" not in controls.legends.content)
    client.set(controls.wind_speed, 20.0)
    until(lambda: ">30 and more<" in controls.legends.content)  # 1.5 times the flow
    client.set(controls.shown, "color")
    until(lambda: not controls.legends.visible)


def _upload(client, button, content, name="x"):
    """As a browser does, under a name of its own: the last transfer's may still be in use."""
    transfer = str(uuid.uuid4())
    client.send(
        "FileTransferStartUpload", source_component_uuid=button._impl.uuid, transfer_uuid=transfer, filename=name,
        mime_type="", part_count=1, size_bytes=len(content),
    )  # fmt: skip
    client.send(
        "FileTransferPart", source_component_uuid=button._impl.uuid, transfer_uuid=transfer, part_index=0,
        content=content,
    )  # fmt: skip


def test_a_configuration_is_loaded(page, client, monkeypatch):
    """What was sent is forgotten before another file may come."""
    session, files, kept = page.session, page.controls.files, []
    ended = files._ended
    monkeypatch.setattr(files, "_ended", lambda: (kept.append(files.load_settings.value.content), ended()))
    given = yaml.safe_load(session.yaml())
    given["wind"]["flow"], given["material"]["E"] = [0.0, 2.5, 0.0], 1.5e4
    before = session.simulation
    _upload(client, files.load_settings, yaml.safe_dump(given).encode())
    until(lambda: session.simulation is not before)
    until(lambda: page.controls.wind_speed.value == 2.5 and not files.load_settings.disabled)
    until(lambda: page.controls.stiffness.value == 1.5e4)
    assert session.changes == 0
    assert not page._bar.visible
    now = session.simulation
    for content, told in (
        (b"wind: {flows: 3}", "flows"),
        (b"\xff\xfe", "UTF-8"),
        (b"scene: {ply: /none/there.ply}", "load it first"),
        (b"a: " + b"[" * 100, "64 levels"),
    ):
        page.tell("")
        _upload(client, files.load_settings, content)
        until(lambda told=told: told in (page.notice or ""))
        until(lambda: not files.load_settings.disabled)
    assert session.simulation is now
    assert kept == [b""] * 5


def test_the_grid_of_the_start_is_refined_up_to_the_configured_one(parser, settings, show, connect):
    """Which another scene forgets."""
    session = Session(parser, settings)
    session.configured_dx = 0.08
    page = show(session)
    client, grid = connect(page), page.controls.grid
    assert grid.options == ("coarse", "normal", "fine", "configured")
    assert grid.value == "normal"
    client.set(grid, "configured")
    until(lambda: session.simulation.solver.dx == 0.08)
    client.set(grid, "fine")
    until(lambda: session.simulation.solver.dx == pytest.approx(0.07))
    session.load(settings, lambda: page.turns.ask("loaded", page.controls.other_scene))
    until(lambda: grid.options == ("coarse", "normal", "fine"))
    assert session.simulation.solver.dx == session.configured_dx == 0.1
    until(lambda: grid.value == "normal")
    assert session.problem is None


def test_configurations_are_not_loaded_where_others_can_open_the_page(show):
    assert show(host="0.0.0.0").controls.files.load_settings.disabled


def test_a_bar_shows_how_far_a_scene_is_loaded(show, connect):
    """From the start, before there is a session; then it goes away."""
    page = Page(port=8480)
    assert page._bar.visible
    assert "Loading" in page._text.content
    connect(page)
    page.progress(0.35, "Making a draft")
    assert page._bar.value == 35
    assert "Making a draft" in page._text.content
    show(page=page)
    assert not page._bar.visible
    until(lambda: "pictures a second" in page._text.content)
    assert "draft" not in page._text.content
    until(lambda: page.drawn_size[0] > 0)  # for the client that came early, too


@pytest.mark.parametrize("name", ["flag.ply", "flag.SPZ"])
def test_a_splat_that_is_loaded_tells_how_far_it_is(name, page, client, tmp_path, monkeypatch):
    """In any format; of the name, which a browser sends, only the ending is used."""
    path = tmp_path / "flag"
    export_cloud(path, FlagScene(width=0.6, height=0.6, spacing=0.05).generate(), format=name[5:].lower())
    told, before = [], page.session.simulation
    tell = page.progress
    monkeypatch.setattr(page, "progress", lambda share, what="": (told.append(share), tell(share, what)))
    _upload(client, page.controls.files.load, path.read_bytes(), f"../../{name}")
    until(lambda: page.session.simulation is not before, 60)
    until(lambda: told[-1] is None)
    shares = [share for share in told if share is not None]
    assert shares == sorted(shares)
    assert len(shares) >= 3
    until(lambda: page.controls.stiffness.value == page.session.settings.material.E)
    assert f"scene{name[4:].lower()}" in page.session.yaml()
