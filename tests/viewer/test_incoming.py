"""What a browser may send to the live page: hostile ones change nothing but values, and break nothing."""

import json
import math
import threading

import pytest

pytest.importorskip("viser", reason="needs the extra [viewer]")
from viser._messages import FileTransferPart, FileTransferStartUpload

from gaussian_swaying.viewer import incoming as incoming_module
from gaussian_swaying.viewer import screen
from gaussian_swaying.viewer.incoming import (
    LARGEST_STROKE,
    MOST_CORNERS,
    TOO_LARGE,
    Incoming,
    brush_move,
    what_is_wrong,
)
from gaussian_swaying.viewer.pictures import draw

from .conftest import pause


@pytest.fixture
def client(page, connect):
    return connect(page)


def _announce(page, name, size, parts=2):
    """Whether an upload is taken; as viser would go on with it."""
    button = page.controls.files.load._impl.uuid
    message = FileTransferStartUpload(button, name, "../../x.ply", "", parts, size)
    if taken := page.incoming._good_upload(message):
        page.server.gui._handle_file_transfer_start(0, message)
    return taken


def _part(page, name, index, content):
    message = FileTransferPart(page.controls.files.load._impl.uuid, name, index, content)
    if taken := page.incoming._good_part(message):
        page.server.gui._handle_file_transfer_part(0, message)
    return taken


def test_uploads_of_sizes_that_cannot_be_are_dropped(page):
    for size, parts in ((0, 0), (0, 2), (-(10**12), 2), (10, 0), (10, -1), (10, 10**6)):
        assert not _announce(page, "odd", size, parts)
    assert page.server.gui._current_file_upload_states == {}


def test_uploads_are_limited_by_the_bytes_that_arrive_from_all_clients(page, monkeypatch):
    assert not _announce(page, "large", (1 << 30) + 1)
    assert "1,024 MiB" in page.notice
    monkeypatch.setattr(incoming_module, "LARGEST_UPLOAD", 1000)
    monkeypatch.setattr(incoming_module, "LEAST_PART", 100)
    under_way = page.server.gui._current_file_upload_states
    assert _announce(page, "one", 900)
    assert _announce(page, "other", 900)  # what is announced counts for nothing
    assert _part(page, "one", 0, b"x" * 800)
    assert not _part(page, "other", 0, b"x" * 201)
    assert list(under_way) == ["one"]
    assert page.notice == TOO_LARGE
    assert not _part(page, "one", 1, b"x" * 101)  # more than was announced
    assert under_way == {}
    for k in range(incoming_module.MOST_UPLOADS):
        assert _announce(page, str(k), 200)
    assert not _announce(page, "one more", 200)
    assert "Another file" in page.notice


def test_a_client_sets_values_only(page, client, until):
    """Neither attributes of the server's handles, nor values of another type, nor those of buttons that are off."""
    slider, hold = page.controls.damping, page.controls.holding.hold
    uuid, callbacks, props = slider._impl.uuid, slider._impl.update_cb, slider._impl.props
    for name in ("uuid", "update_cb", "props", "removed", "gui_api", "is_button"):
        client.send("GuiUpdateMessage", uuid=uuid, updates={name: 3})
        client.send("GuiUpdateMessage", uuid=uuid, updates={"value": 3.0, name: 3})
    client.send("GuiUpdateMessage", uuid=uuid, updates={})
    client.send("GuiUpdateMessage", uuid=uuid, updates="value")
    client.set(hold, True)
    client.set(page.controls.files.load, "text")
    client.send("GuiFormDirtyMessage", uuid="many of them stay in memory")
    client.send("NoSuchMessage")
    client.socket.send(b"\xff\x00 neither")
    client.socket.send("text")
    client.set(slider, 4.0)
    until(lambda: slider.value == 4.0)
    assert (slider._impl.uuid, slider._impl.removed, slider._impl.is_button) == (uuid, False, False)
    assert slider._impl.update_cb is callbacks
    assert slider._impl.props is props
    until(lambda: page.session.settings.solver.damping == 4.0)
    assert page.session.problem is None


def test_a_value_out_of_range_gets_a_sentence(page, client, until):
    assert what_is_wrong(page.controls.wind_speed, 31) == "Speed [m/s] goes from 0 to 30: 31 was refused."
    bad = {"wind_speed": (1e9, -1, float("nan"), "12", True, None), "shown": ("everything", 3), "shading": ("yes", 1)}
    good = {"wind_speed": 12.0, "shown": "normals", "shading": False}
    for name, values in bad.items():
        handle = getattr(page.controls, name)
        before = handle.value
        for value in values:
            page.tell("")
            client.set(handle, value)
            until(lambda: page.notice)
            assert handle.label in page.notice
            assert handle.value == before
        client.set(handle, good[name])
        # the sentence is on a number that is being typed
        until(lambda handle=handle, value=good[name]: not page.notice and handle.value == value)


def test_cameras_that_cannot_be_are_dropped(page, client, until):
    camera, bad = next(iter(page.server.get_clients().values())).camera, float("nan")
    for change in (
        {"position": [bad, 0, 0]}, {"position": [1, 2]}, {"wxyz": [0, 0, 0, 0]}, {"fov": 0.0}, {"fov": 4.0},
        {"image_width": float("inf")}, {"image_height": -5}, {"near": "x"}, {"look_at": None},
    ):  # fmt: skip
        client.look(**({"fov": 0.5} | change))
    client.look(fov=0.6)
    until(lambda: camera.fov != 0.8)
    assert camera.fov == 0.6
    assert page.notice is None


def test_no_camera_makes_a_picture_larger_than_the_limit(page, connect, until, monkeypatch):
    sizes = []
    monkeypatch.setattr(screen, "draw", lambda *args: sizes.append((args[1].width, args[1].height)) or draw(*args))
    client = connect(page, 1, 2_000_000)
    until(lambda: sizes)
    client.look(image_width=2_000_000, image_height=1)
    until(lambda: sizes[-1][0] > sizes[-1][1])
    assert max(max(size) for size in sizes) <= page.largest


def test_handles_are_not_dragged_to_the_end_of_the_world(page, client, until):
    tip = page.controls._tip
    before = tuple(tip.position)
    for place in ([1e30, 0, 0], [1e6, 0, 0], [float("nan"), 0, 0], [1, 2], "abc"):
        client.drag("/wind/tip", place)
    until(lambda: page.notice is not None)
    assert "dragged that far" in page.notice
    assert tuple(tip.position) == before
    client.drag("/wind/tip", [0.0, 0.0, 1.0])
    until(lambda: tuple(page.controls._tip.position) != before)
    for origin, direction in (([0, 0, 0], [0, 0, 0]), ([float("inf"), 0, 0], [1, 0, 0]), (None, None)):
        client.click(origin, direction)
    client.set(page.controls.damping, 7.5)
    until(lambda: page.session.settings.solver.damping == 7.5)  # after all that came before
    assert not page.session.pulls


def test_before_the_server_is_there_nothing_passes():
    assert not Incoming(print).takes(b"")


def test_what_is_held_is_drawn_between_changes(page):
    """A change takes the solver's material away for a moment."""
    session, solver = page.session, page.session.simulation.solver
    pause(session)
    drawn, asked, lock = [], threading.Event(), session.lock

    class Asked:
        def __enter__(self):
            asked.set()
            return lock.__enter__()

        def __exit__(self, *error):
            return lock.__exit__(*error)

    drawing = threading.Thread(target=lambda: drawn.append(page.controls.holding.places()))
    with lock:
        bound, solver._bound = solver._bound, None
        session.lock = Asked()
        drawing.start()
        assert asked.wait(60)
        solver._bound = bound
    drawing.join()
    assert len(drawn[0]) > 0


STROKE = {"kind": "stroke", "first": True, "path": [[3.0, 4.5]], "size": [640, 480.0], "fov": 40.0, "near": 0.01}
STROKE |= {"matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 7, 8, 9, 1]}


def test_a_stroke_is_read():
    move = brush_move(json.dumps(STROKE))
    assert (move.kind, move.first, move.path, move.size) == ("stroke", True, [[3.0, 4.5]], (640, 480))
    assert move.fov == pytest.approx(math.radians(40))
    assert [row[3] for row in move.matrix] == [7, 8, 9, 1]  # the columns come one after another
    assert brush_move(json.dumps(STROKE | {"path": [[0, 0]] * MOST_CORNERS, "kind": "part"})).kind == "part"


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "erase"}, {"kind": None}, {"first": 1}, {"path": []}, {"path": "ab"}, {"path": [[1, 2, 3]]},
        {"path": [[0, 0]] * (MOST_CORNERS + 1)}, {"path": [[math.nan, 0]]}, {"path": [[math.inf, 0]]},
        {"path": [[1e6, 0]]}, {"path": [[True, 0]]}, {"path": [["1", 0]]}, {"size": [0, 480]}, {"size": [1e9, 480]},
        {"size": [480]}, {"fov": 0}, {"fov": 180}, {"fov": math.nan}, {"near": 0}, {"near": "x"},
        {"matrix": [1.0] * 15},
        {"matrix": [1.0] * 16}, {"matrix": [0.0] * 16}, {"matrix": [math.nan] * 16}, {"role": "held"},
        {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, {"matrix": [[1, 0], [0, 1]] * 4},
    ],
)  # fmt: skip
def test_a_stroke_that_cannot_be_is_dropped(change):
    assert brush_move(json.dumps(STROKE)) is not None
    assert brush_move(json.dumps(STROKE | change)) is None
    for raw in (b"{}", "{", "null", "[" * 9000, " " * (LARGEST_STROKE + 1), '{"kind": "part"}'):
        assert brush_move(raw) is None
