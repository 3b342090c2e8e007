"""Parts that are painted on the live page, as a browser asks for them without a browser."""

import json

import numpy as np
import pytest
import torch
import yaml
from browsers import reached, until

pytest.importorskip("viser", reason="needs the extra [viewer]")
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as connect_socket

from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.parts import ROLES, Part, Parts
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.rendering.cameras.camera import look_at_camera, project
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.viewer import controls
from gaussian_swaying.viewer.controls import ALIKE, JOINED, choices
from gaussian_swaying.viewer.session import Session
from gaussian_swaying.viewer.streams import brush_move

SIZE = (400, 300)
CAMERA = look_at_camera((0.6, -2.2, 0.3), (0.6, 0.0, 0.4), (0, 0, 1), 40.0, *SIZE, dtype=torch.float64)


class Painter:
    """A browser that paints, without a browser."""

    def __init__(self, page, key):
        self.page = page
        self.socket = connect_socket(
            f"{page.url.replace('http', 'ws')}/brush?key={key}", close_timeout=1, ping_interval=None
        )

    def told(self):
        return json.loads(self.socket.recv(timeout=20))

    def choose(self, control, value):
        """Set a control; a stroke comes by another connection, so that it might be there first."""
        self.client.set(control, value)
        until(lambda: control.value == value)

    def move(self, *path, kind="stroke", first=True, **other):
        """Send what the program of the page would."""
        self.socket.send(json.dumps(message(self.page._turn, *path, kind=kind, first=first, **other)))


def message(turn, *path, camera=CAMERA, **fields):
    view = camera.world_to_camera
    matrix = torch.eye(4).double()
    matrix[:3, :3] = turn @ view[:3, :3].T @ torch.diag(torch.tensor([1.0, -1.0, -1.0]).double())
    matrix[:3, 3] = turn @ camera.position
    told = {"kind": "stroke", "first": True, "path": [list(map(float, place)) for place in path], "size": SIZE}
    return told | {"fov": 40.0, "near": 0.01, "matrix": matrix.T.flatten().tolist()} | fields


def _joined(page, join):
    client, key = join(page)
    made = Painter(page, key)
    made.client = client
    return made


@pytest.fixture
def painter(page, join):
    """One whose page paints, and its browser as viser knows it."""
    made = _painting(page, join)
    yield made
    made.socket.close()


def _painting(page, join):
    made = _joined(page, join)
    assert made.told() == {"on": False}
    motion = page.session.snapshot.motion
    made.client.set(page.controls.painting.on, True)
    assert made.told() == {"on": True, "radius": 20.0}
    until(lambda: page.session.paused and page.session.snapshot.motion > motion)  # which begins at rest
    assert page.session.snapshot.health.time == 0
    return made


@pytest.fixture
def places(page):
    """Where the Gaussians are on the screen of the painter [pixels], shape (N, 2)."""
    return project(page.session.simulation.scene.model.means, CAMERA)[0].numpy()


def _labelled(page, role="held"):
    return page.controls.painting._strokes.roles.numpy() == ROLES.index(role)


def _near(places, place, radius=20.0):
    return np.linalg.norm(places - np.array(place), axis=1) <= radius


def test_while_it_is_painted_the_object_is_at_rest_and_then_it_goes_on(page, join):
    session, painting = page.session, page.controls.painting
    painter = _joined(page, join)
    client = painter.client
    assert painter.told() == {"on": False}
    reached(session, 0.05)
    came, take = [], page.brushes.take
    page.brushes.take = lambda key, move: (take(key, move), came.append(move))
    painter.move([200, 150])  # before painting is on
    until(lambda: came)
    client.set(painting.on, True)
    assert painter.told() == {"on": True, "radius": 20.0}
    until(lambda: session.paused and session.snapshot.health.time == 0)
    until(lambda: page.controls.pause.label == "Go on")
    assert not _labelled(page).any()
    assert page.roles.tolist() == [0] * len(page.roles)
    client.set(painting.size, 90)
    assert painter.told() == {"on": True, "radius": 45.0}
    client.set(painting.on, False)
    assert not painter.told()["on"]
    reached(session, 0.05)
    assert page.roles is None
    session.pause()
    client.set(painting.on, True)
    assert painter.told()["on"]
    client.set(painting.on, False)
    assert not painter.told()["on"]
    until(lambda: not painting.on.value)
    assert session.paused  # as it was before
    assert session.problem is None


def test_a_stroke_paints_what_is_under_it_and_is_undone_as_a_whole(page, painter, places):
    painting = page.controls.painting
    first, second = _near(places, [150, 140]), _near(places, [230, 170])
    painter.move([150, 140])
    until(lambda: np.array_equal(_labelled(page), first))
    assert first.any()
    version = page._version
    painter.choose(painting.part, "still")
    painter.move([230, 165])
    painter.move([230, 165], [230, 170], first=False)
    until(lambda: np.array_equal(_labelled(page, "still"), second | _near(places, [230, 165])))
    still = int(_labelled(page, "still").sum())
    until(lambda: f"still: {still} Gaussians" in painting.legend.content)  # which is shown last
    assert page.roles.tolist() == painting._strokes.roles.tolist()
    assert page._version > version  # the server draws it, too
    assert len(painting._strokes) == 2
    assert f"held: {int(first.sum())} Gaussians" in painting.legend.content
    painter.client.set(painting.back, True)
    until(lambda: not _labelled(page, "still").any())
    assert np.array_equal(_labelled(page), first)
    painter.client.set(painting.back, True)
    until(lambda: painting.back.disabled)
    assert not _labelled(page).any()
    assert page.notice is None


def test_the_camera_is_that_of_the_browser(page):
    """Whatever up is in the scene: the axes of viser's camera are turned."""
    for turn in (page._turn, torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]).double()):
        page._turn = turn
        move = brush_move(json.dumps(message(turn, [1, 2])))
        camera = page.camera_of(move)
        torch.testing.assert_close(camera.world_to_camera, CAMERA.world_to_camera)
        torch.testing.assert_close(camera.intrinsics, CAMERA.intrinsics)
        assert (camera.width, camera.height, camera.near) == (*SIZE, 0.01)


def test_a_double_click_takes_what_hangs_together(page, painter, places):
    """And not what its two clicks painted before; beside the object it takes nothing."""
    painting, count = page.controls.painting, len(places)
    painter.choose(painting.part, "still")
    painter.move([150, 140])
    until(lambda: _labelled(page, "still").any())
    painter.choose(painting.part, "held")
    painter.choose(painting.double, ALIKE)
    colours = 0.5 + SH_DC * page.session.simulation.scene.model.sh0[:, 0]
    nearest = np.linalg.norm(places - [200, 150], axis=1).argmin()
    same = ((colours - colours[nearest]).norm(dim=-1) < 0.2).numpy()  # some on its edge
    for place in ([200, 150], [200, 151]):
        painter.move(place)
        painter.move(place, [place[0] + 1, place[1]], first=False)
    painter.move([200, 150], kind="part")
    until(lambda: np.array_equal(_labelled(page), same))
    assert 0 < same.sum() < count / 2
    assert len(painting._strokes) == 2  # of which the first is left
    assert page._bar.visible is False
    painter.choose(painting.double, JOINED)
    painter.move([200, 150], kind="part")
    until(lambda: _labelled(page).all())
    painter.choose(painting.part, "soft")
    painter.move([5, 5], kind="part")
    painter.move([200, 150])
    until(lambda: not _labelled(page).all())
    assert np.array_equal(~_labelled(page), _near(places, [200, 150]))


def test_two_browsers_paint_strokes_of_their_own(page, painter, join, places):
    other = _joined(page, join)
    assert other.told()["on"]
    for place in ([120, 140], [130, 140]):
        painter.move(place, first=place[0] == 120)
        until(lambda: _labelled(page).any())
        other.move([place[0] + 120, 140], first=place[0] == 120)
    expected = [_near(places, [x, 140]) for x in (120, 240, 130, 250)]
    until(lambda: np.array_equal(_labelled(page), np.logical_or.reduce(expected)))
    while len(page.controls.painting._strokes):
        page.controls.painting._take_back()
    assert not _labelled(page).any()
    other.socket.close()


def test_it_paints_while_a_video_is_recorded(page, painter):
    """The video goes on afterwards."""
    client, painting = painter.client, page.controls.painting
    client.set(page.controls.files.record, True)
    until(lambda: page.recording is not None)
    painter.move([200, 150])
    until(lambda: _labelled(page).any())
    until(lambda: page.recording.seconds > 0)
    client.set(painting.apply, True)
    before = page.recording.seconds
    until(lambda: page.recording.seconds > before + 0.1)
    assert page.session.problem is None


def test_parts_are_applied_with_the_size_that_the_object_has(page, painter, places):
    """What becomes still does not count for `scene.longest_side`; the change is undone as any other."""
    session, painting = page.session, page.controls.painting
    session.change({"scene.longest_side": 2.4, "scene.metres_per_unit": None})
    until(lambda: session.settings.scene.longest_side == 2.4)
    metres = session.simulation.scene.frame.metres_per_unit
    right = places[:, 0] > 240
    painter.choose(painting.part, "still")
    painter.choose(painting.size, 400)
    painter.move([440, 150])  # which reaches to 240
    until(lambda: _labelled(page, "still").any())
    still = _labelled(page, "still").copy()
    assert 0.1 < still.mean() < 0.5
    assert not still[~right].any()
    before = session.simulation
    painter.client.set(painting.apply, True)
    until(lambda: session.simulation is not before or session.problem)
    scene = session.simulation.scene
    assert not still[scene.simulated.numpy()].any()
    assert len(scene.simulated) == (~still).sum()
    assert scene.frame.metres_per_unit == pytest.approx(metres)
    reached(session, 0.05)  # it goes on
    assert page.roles is None
    assert not painting.on.value
    session.undo()
    until(lambda: session.settings.scene.longest_side == 2.4)
    assert session.simulation.scene.parts is None
    assert session.problem is None


def test_what_cannot_move_is_refused_and_what_was_painted_is_kept(page, painter):
    session, painting = page.session, page.controls.painting
    painter.move([200, 150], kind="part")
    until(lambda: _labelled(page).all())
    before = session.simulation
    painter.client.set(painting.apply, True)
    until(lambda: session.problem is not None)
    assert "Nothing is left to move" in session.problem
    assert session.simulation is before
    assert _labelled(page).all()
    assert not painting.apply.disabled


def test_a_saved_configuration_names_the_parts_beside_it(page, painter):
    session, painting = page.session, page.controls.painting
    assert painting.as_saved(session.yaml()) == session.yaml()
    painter.move([200, 150])
    until(lambda: _labelled(page).any())
    painter.client.set(painting.apply, True)
    until(lambda: session.settings.scene.parts is not None)
    text = painting.as_saved(session.yaml())
    assert "Save the parts" in text.splitlines()[0]
    assert yaml.safe_load(text)["scene"]["parts"] == "parts.npz"


def test_files_of_parts_stay_while_a_change_can_be_undone(page, painter, monkeypatch):
    session, painting = page.session, page.controls.painting
    monkeypatch.setattr(session, "_past", type(session._past)(maxlen=2))
    for k in range(5):
        painting.on.value = True
        painting._begin()
        painting._strokes.paint(Part("held", "held"), torch.tensor([k]))
        before = session.simulation
        painting._apply()
        until(lambda before=before: session.simulation is not before)
    there = {str(path) for path in (page.scratch / "painted").glob("*/parts.npz")}
    assert {str(known.scene.parts) for known in session.reachable()} - {"None"} <= there
    assert len(there) <= 4


def test_labels_count_the_gaussians_that_are_not_drawn(parser, settings, show, join, tmp_path):
    """With `scene.faint: drop` the file has more than the page draws."""
    cloud = FlagScene(spacing=0.05).generate()
    faint = torch.arange(len(cloud.means)) % 3 == 0
    cloud.opacities[faint] = -4.0
    write_ply(tmp_path / "flag.ply", cloud)
    values = ["--scene.faint=drop", f"--scene.ply={tmp_path / 'flag.ply'}", "--solver.dx=0.1", "--device=cpu"]
    session = Session(parser, parser.parse_args([f"--config={settings.config[0]}", *values]))
    page = show(session)
    painter = _painting(page, join)
    assert len(page.roles) == (~faint).sum()
    painter.move([200, 150])
    until(lambda: _labelled(page).any())
    places = project(cloud.means, CAMERA)[0].numpy()
    assert np.array_equal(_labelled(page), _near(places, [200, 150]) & ~faint.numpy())
    painter.client.set(page.controls.painting.apply, True)
    until(lambda: session.simulation.scene.parts is not None)
    assert session.problem is None
    assert len(session.simulation.scene.parts) == len(cloud.means)


def test_a_scene_that_changed_meanwhile_is_painted_from_new(page, painter):
    """Strokes are labels of Gaussians that are there no more."""
    session, painting = page.session, page.controls.painting
    painter.move([200, 150])
    until(lambda: _labelled(page).any())
    before = session.simulation
    session.change({"scene.generator.init_args.spacing": 0.05})
    until(lambda: session.simulation is not before)
    count = len(session.simulation.scene.model.means)
    painter.move([150, 140])
    until(lambda: len(painting._strokes.labels) == count and _labelled(page).any())
    assert len(painting._strokes) == 1
    assert session.problem is None


def test_copies_are_not_painted(page, connect):
    page.session.settings.copies = [{}]
    connect(page).set(page.controls.painting.on, True)
    until(lambda: page.notice is not None)
    assert "leave out `copies`" in page.notice
    assert not page.controls.painting.on.value
    page.session.settings.copies = []


def test_who_has_no_key_cannot_paint(page):
    painter = Painter(page, "guessed")
    with pytest.raises(ConnectionClosed):
        painter.told()


def test_no_more_moves_wait_than_there_is_room_for(page, painter, monkeypatch):
    painting = page.controls.painting
    monkeypatch.setattr(page.turns, "ask", lambda key, what: None)
    monkeypatch.setattr(controls, "MOST_WAITING", 3)
    move = brush_move(json.dumps(message(page._turn, [1, 2])))
    for _ in range(10):
        painting._came("a", move)
    assert len(painting._waiting) == 3
    painting._waiting.clear()


def test_a_browser_that_goes_is_forgotten(page, painter):
    painter.client.close()
    with pytest.raises(ConnectionClosed):
        painter.socket.recv(timeout=20)
    until(lambda: not page.brushes._open)


def test_choices_are_the_parts_and_a_new_one_of_each_role():
    pot, plant, own = Part("pot", "still"), Part("plant", E=1e5), Part("held", "soft")
    found = choices([pot, plant, own])
    assert list(found)[:3] == ["pot (still)", "plant (soft)", "held (soft)"]
    assert found["pot (still)"] is pot
    assert found["still"] == Part("still", "still")
    assert set(found) - {"pot (still)", "plant (soft)", "held (soft)"} == set(ROLES) - {"held"}  # the name is taken
    assert list(choices([Part("soft")])) == ["soft", *(role for role in ROLES if role != "soft")]


def test_parts_of_the_scene_are_painted_on(settings, show, join, tmp_path):
    given = Parts(torch.arange(1536) % 2, [Part("<cloth>", E=5e3), Part("pole", "held")])
    given.save(tmp_path / "parts.npz")
    settings.scene.parts = str(tmp_path / "parts.npz")
    page = show()
    painter = _painting(page, join)
    assert page.controls.painting.part.options[:2] == ("<cloth> (soft)", "pole (held)")
    assert page.roles.tolist() == [ROLES.index(given.parts[k].role) for k in given.labels]
    painter.choose(page.controls.painting.part, "<cloth> (soft)")
    painter.move([200, 150])
    strokes = page.controls.painting._strokes
    until(lambda: strokes.parts().mask("<cloth>").sum() > given.mask("<cloth>").sum())
    assert len(strokes) == 1
    assert strokes.parts().parts == given.parts
