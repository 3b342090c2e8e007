"""Parts are painted with the mouse in a real browser, saved, and taken by the simulation."""

import numpy as np
import pytest
import torch
from browsers import picture_of, reached, until

from gaussian_swaying.gaussians.parts import ROLES, Parts
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.rendering.tints import TINTS

pytest.importorskip("viser", reason="needs the extra [viewer]")
from gaussian_swaying.viewer.pictures import camera_of

from .conftest import READY

CLIP = {"x": 0, "y": 200, "width": 750, "height": 600}  # beside the controls and below what viser tells


@pytest.fixture
def window(open_window):
    """A window whose folder for painting is open."""
    opened = open_window()
    opened.wait_for_function(READY)
    opened.get_by_text("Paint parts", exact=True).click()
    return opened


def _picture(window):
    window.wait_for_function("wind.left === 0 && wind.drawing.sorted")
    window.mouse.move(20, 880)  # the ring of the brush follows it
    return picture_of(window, **CLIP)


def _click(window, name):
    button = window.get_by_role("button", name=name, exact=True)
    window.wait_for_function("(button) => !button.disabled", arg=button.element_handle())
    button.dispatch_event("click")


def _begin(page, window):
    """Switch painting on: the object goes back to rest."""
    window.get_by_label("Paint", exact=True).dispatch_event("click")
    window.wait_for_function("wind.brush.on && wind.playback.shown === 0")
    until(lambda: page.session.paused and page.session.snapshot.health.time == 0)


def _places(page, window):
    """Where the Gaussians are in the window at rest [pixels], shape (N, 2)."""
    pose = next(iter(page.server.get_clients().values())).camera
    size = window.viewport_size
    camera = camera_of(pose.wxyz, pose.position, pose.fov, size["width"], size["height"])
    return project(page.session.simulation.scene.model.means, camera)[0].numpy()


def _distance(places, a, b):
    """Distance of places (N, 2) from the line between two of them [pixels]."""
    share = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(places - a - share[:, None] * (b - a), axis=1)


def _stroke(window, a, b):
    window.mouse.move(*a)
    window.mouse.down()
    window.mouse.move(*b, steps=9)
    window.mouse.up()


def test_a_stroke_is_seen_undone_saved_and_applied(page, window, tmp_path):
    """What was painted as held stays exactly where it is in the wind, while the rest moves."""
    session, painting = page.session, page.controls.painting
    reached(session, 0.1)
    page.controls.arrow.value = False  # what viser draws above the object is made again with each simulation
    page.controls.draw_handles()
    _begin(page, window)
    plain = _picture(window)
    places = _places(page, window)
    middle = places[np.abs(places - [550, 450]).sum(1).argmin()]
    a, b = middle - np.array([90, 40]), middle + np.array([90, 60])
    away = _distance(places, a, b)
    near, far = away < 19, away > 21  # the brush has a radius of 20 pixels

    def painted():
        held = painting._strokes.roles.numpy() == ROLES.index("held")
        return held[near].all() and not held[far].any()

    for time in ("first", "second"):
        _stroke(window, a, b)
        until(painted)
        line = [tuple((a + share * (b - a) - [CLIP["x"], CLIP["y"]]).round().astype(int)) for share in (0.1, 0.5, 0.9)]
        until(lambda line=line: all(_is_tinted(_picture(window)[y, x], plain[y, x]) for x, y in line))
        aside = _picture(window) - plain
        assert np.abs(aside[-100:]).max() < 3  # below the stroke
        assert len(painting._strokes) == 1
        if time == "first":
            _click(window, "Undo the stroke")
            until(lambda: np.abs(_picture(window) - plain).max() < 3)
            assert not painting._strokes.roles.any()

    with window.expect_download(timeout=30_000) as download:
        _click(window, "Save the parts")
    assert download.value.suggested_filename == "parts.npz"
    download.value.save_as(tmp_path / "parts.npz")
    saved = Parts.load(tmp_path / "parts.npz")
    held = saved.mask(role="held").numpy()
    assert len(saved) == len(places)
    assert held[near].all()
    assert not held[far].any()

    before, rest = session.simulation, session.simulation.scene.rest().means.numpy()
    _click(window, "Apply the parts")
    until(lambda: session.simulation is not before and session.snapshot.health.time > 0.3)
    assert torch.equal(session.simulation.scene.parts.labels, saved.labels)
    moved = np.linalg.norm(session.simulation.scene.deformed(session.snapshot.state).means.numpy() - rest, axis=1)
    assert moved[held].max() == 0
    assert np.median(moved[~held]) > 1e-3
    window.wait_for_function("!wind.brush.on")
    session.pause()
    session.reset()
    until(lambda: np.abs(_picture(window) - plain).max() < 40)  # without tints; what is held has no shading
    assert session.problem is None
    assert window.problems == []


def _is_tinted(now, before):
    """Whether a pixel got most of the way towards the colour of what is held."""
    return np.abs(now - (0.3 * before + 0.7 * np.array(TINTS["held"]))).max() < 40 < np.abs(now - before).max()
