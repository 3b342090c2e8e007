import numpy as np
import pytest
import torch
import yaml
from browsers import reached, until
from shared import value_error

from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.parts import ROLES, Part, Parts
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.player.painting import FILE, TOGETHER, Painting, choices
from gaussian_swaying.player.pictures import Eye
from gaussian_swaying.player.session import Session
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.rendering.tints import TINTS
from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import LOOK

JOINED, ALIKE = TOGETHER


def _move(painting, *path, part="held", key="a", **other):
    told = {"path": path, "radius": 20.0, "part": part, "first": True, "through": False, "how": None, **LOOK}
    painting.paint(key, told | other)


@pytest.fixture
def start(tmp_path):
    def start(session):
        if not session._thread.is_alive():
            session.start()
        painting = Painting(session, tmp_path)
        motion = session.snapshot.motion
        painting.begin()
        until(lambda: session.paused and session.snapshot.motion > motion)
        assert session.snapshot.health.time == 0
        return painting

    return start


@pytest.fixture
def painting(session, start):
    return start(session)


def _places(session):
    """Where the Gaussians are in the window [pixels], shape (N, 2)."""
    scene = session.simulation.scene
    return project(scene.model.means, Eye.told(LOOK).camera(scene, *LOOK["size"]))[0].numpy()


@pytest.fixture
def places(session):
    return _places(session)


def _labelled(painting, role="held"):
    return painting._strokes.roles.numpy() == ROLES.index(role)


def _near(places, place, radius=20.0):
    return np.linalg.norm(places - np.array(place), axis=1) <= radius


def test_while_it_is_painted_the_object_is_at_rest_and_then_it_goes_on(session, tmp_path):
    session.start()
    painting = Painting(session, tmp_path)
    reached(session, 0.05)
    _move(painting, [200, 150])  # before painting is on
    assert painting.roles is None
    painting.begin()
    until(lambda: session.paused and session.snapshot.health.time == 0)
    assert painting.roles.tolist() == [0] * len(painting.roles)
    painting.stop()
    reached(session, 0.05)
    assert painting.roles is None
    session.pause()
    painting.begin()
    painting.stop()
    assert session.paused  # as it was before
    assert session.problem is None


def test_a_stroke_paints_what_is_under_it_and_is_undone_as_a_whole(painting, places):
    first, second = _near(places, [150, 140]), _near(places, [230, 170])
    _move(painting, [150, 140])
    assert np.array_equal(_labelled(painting), first)
    assert first.any()
    _move(painting, [230, 165], part="still")
    _move(painting, [230, 165], [230, 170], part="still", first=False)
    assert np.array_equal(_labelled(painting, "still"), second | _near(places, [230, 165]))
    still = int(_labelled(painting, "still").sum())
    shown = {part["name"]: part for part in painting.shown()["parts"]}
    assert (shown["still"]["count"], shown["held"]["count"]) == (still, first.sum())
    assert tuple(shown["held"]["tint"]) == TINTS["held"]
    assert shown["soft"]["tint"] is None
    assert painting.roles.tolist() == painting._strokes.roles.tolist()
    assert len(painting._strokes) == 2
    painting.take_back()
    assert not _labelled(painting, "still").any()
    assert np.array_equal(_labelled(painting), first)
    painting.take_back()
    assert not painting.shown()["undo"]
    assert not _labelled(painting).any()


def test_a_double_click_takes_what_hangs_together(painting, places):
    count = len(places)
    _move(painting, [150, 140], part="still")
    colours = 0.5 + SH_DC * painting.session.simulation.scene.model.sh0[:, 0]
    nearest = np.linalg.norm(places - [200, 150], axis=1).argmin()
    same = ((colours - colours[nearest]).norm(dim=-1) < 0.2).numpy()  # some on its edge
    for place in ([200, 150], [200, 151]):
        _move(painting, place)
        _move(painting, place, [place[0] + 1, place[1]], first=False)
    _move(painting, [200, 150], how=ALIKE)
    assert np.array_equal(_labelled(painting), same)
    assert 0 < same.sum() < count / 2
    assert len(painting._strokes) == 2  # of which the first is left
    _move(painting, [200, 150], how=JOINED)
    assert _labelled(painting).all()
    _move(painting, [5, 5], part="soft", how=JOINED)
    _move(painting, [200, 150], part="soft")
    assert np.array_equal(~_labelled(painting), _near(places, [200, 150]))


def test_two_browsers_paint_strokes_of_their_own(painting, places):
    for place in ([120, 140], [130, 140]):
        _move(painting, place, first=place[0] == 120)
        _move(painting, [place[0] + 120, 140], first=place[0] == 120, key="b")
    expected = [_near(places, [x, 140]) for x in (120, 240, 130, 250)]
    assert np.array_equal(_labelled(painting), np.logical_or.reduce(expected))
    while len(painting._strokes):
        painting.take_back()
    assert not _labelled(painting).any()


@pytest.mark.parametrize(
    "wrong",
    [
        {"path": []},
        {"path": [[1, 2, 3]]},
        {"path": [[0, float("nan")]]},
        {"radius": 0},
        {"radius": 1e9},
        {"how": "all"},
    ],
    ids=str,
)
def test_a_brush_that_cannot_be_is_refused(painting, wrong):
    with value_error("brush"):
        _move(painting, [200, 150], **wrong)
    assert not _labelled(painting).any()


def _applied(painting):
    session = painting.session
    before = session.simulation
    painting.apply()
    until(lambda: session.simulation is not before or session.problem)


def test_parts_are_applied_with_the_size_that_the_object_has(session, start):
    session.start()
    session.change({"scene.longest_side": 2.4, "scene.metres_per_unit": None})
    until(lambda: session.settings.scene.longest_side == 2.4)
    painting, places = start(session), _places(session)
    metres = session.simulation.scene.frame.metres_per_unit
    _move(painting, [440, 150], part="still", radius=200.0)  # which reaches to 240
    still = _labelled(painting, "still").copy()
    assert 0.1 < still.mean() < 0.5
    assert not still[places[:, 0] <= 240].any()
    _applied(painting)
    scene = session.simulation.scene
    assert not still[scene.simulated.numpy()].any()
    assert len(scene.simulated) == (~still).sum()
    assert scene.frame.metres_per_unit == pytest.approx(metres)
    reached(session, 0.05)  # it goes on
    assert painting.roles is None
    session.undo()
    until(lambda: session.settings.scene.longest_side == 2.4)
    assert session.simulation.scene.parts is None
    assert session.problem is None


def test_what_cannot_move_is_refused_and_what_was_painted_is_kept(painting):
    session = painting.session
    _move(painting, [200, 150], how=JOINED)
    before = session.simulation
    _applied(painting)
    assert "Nothing is left to move" in session.problem
    assert session.simulation is before
    assert _labelled(painting).all()
    assert painting.shown()["apply"]


def test_a_saved_configuration_names_the_parts_beside_it(painting, tmp_path):
    session = painting.session
    assert painting.as_saved(session.yaml()) == session.yaml()
    _move(painting, [200, 150])
    held = _labelled(painting).copy()
    painting.saved(tmp_path / FILE)
    assert np.array_equal(Parts.load(tmp_path / FILE).mask(role="held").numpy(), held)
    _applied(painting)
    text = painting.as_saved(session.yaml())
    assert "Save the parts" in text.splitlines()[0]
    assert yaml.safe_load(text)["scene"]["parts"] == FILE


def test_files_of_parts_stay_while_a_change_can_be_undone(painting, monkeypatch, tmp_path):
    session = painting.session
    monkeypatch.setattr(session, "_past", type(session._past)(maxlen=2))
    for k in range(5):
        painting.begin()
        painting._strokes.paint(Part("held", "held"), torch.tensor([k]))
        _applied(painting)
    there = {str(path) for path in (tmp_path / "painted").glob("*/parts.npz")}
    assert {str(known.scene.parts) for known in session.reachable()} - {"None"} <= there
    assert len(there) <= 4


def test_labels_count_the_gaussians_that_are_not_drawn(parser, settings, start, tmp_path):
    cloud = FlagScene(spacing=0.05).generate()
    faint = torch.arange(len(cloud.means)) % 3 == 0
    cloud.opacities[faint] = -4.0
    write_ply(tmp_path / "flag.ply", cloud)
    values = ["--scene.faint=drop", f"--scene.ply={tmp_path / 'flag.ply'}", "--solver.dx=0.1", "--device=cpu"]
    session = Session(parser, parser.parse_args([f"--config={settings.config[0]}", *values]))
    painting = start(session)
    assert len(painting.roles) == (~faint).sum()
    scene = session.simulation.scene
    _move(painting, [200, 150])
    places = project(cloud.means, Eye.told(LOOK).camera(scene, *LOOK["size"]))[0].numpy()
    assert np.array_equal(_labelled(painting), _near(places, [200, 150]) & ~faint.numpy())
    _applied(painting)
    assert session.problem is None
    assert len(session.simulation.scene.parts) == len(cloud.means)
    session.close()


def test_a_scene_that_changed_meanwhile_is_painted_from_new(painting):
    session = painting.session
    _move(painting, [200, 150])
    before = session.simulation
    session.change({"scene.generator.init_args.spacing": 0.05})
    until(lambda: session.simulation is not before)
    _move(painting, [150, 140])
    assert len(painting._strokes.labels) == len(session.simulation.scene.model.means)
    assert len(painting._strokes) == 1
    assert session.problem is None


def test_copies_are_not_painted(session, tmp_path):
    session.settings.copies = [{}]
    with value_error("leave out `copies`"):
        Painting(session, tmp_path).begin()


def test_choices_are_the_parts_and_a_new_one_of_each_role():
    pot, plant, own = Part("pot", "still"), Part("plant", E=1e5), Part("held", "soft")
    found = choices([pot, plant, own])
    assert list(found)[:3] == ["pot (still)", "plant (soft)", "held (soft)"]
    assert found["pot (still)"] is pot
    assert found["still"] == Part("still", "still")
    assert set(found) - {"pot (still)", "plant (soft)", "held (soft)"} == set(ROLES) - {"held"}  # the name is taken
    assert list(choices([Part("soft")])) == ["soft", *(role for role in ROLES if role != "soft")]


def test_parts_of_the_scene_are_painted_on(parser, settings, start, tmp_path):
    given = Parts(torch.arange(1536) % 2, [Part("<cloth>", E=5e3), Part("pole", "held")])
    given.save(tmp_path / "parts.npz")
    settings.scene.parts = str(tmp_path / "parts.npz")
    session = Session(parser, settings)
    painting = start(session)
    assert [part["name"] for part in painting.shown()["parts"][:2]] == ["<cloth> (soft)", "pole (held)"]
    assert painting.roles.tolist() == [ROLES.index(given.parts[k].role) for k in given.labels]
    _move(painting, [200, 150], part="<cloth> (soft)")
    strokes = painting._strokes
    assert strokes.parts().mask("<cloth>").sum() > given.mask("<cloth>").sum()
    assert len(strokes) == 1
    assert strokes.parts().parts == given.parts
    session.close()
