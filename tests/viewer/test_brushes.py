"""What a browser sends to the live page."""

import threading

import pytest
from browsers import until

pytest.importorskip("viser", reason="needs the extra [viewer]")

from gaussian_swaying.viewer import screen
from gaussian_swaying.viewer.pictures import draw

from .conftest import pause


def test_no_camera_makes_a_picture_larger_than_the_limit(page, connect, monkeypatch):
    sizes = []
    monkeypatch.setattr(screen, "draw", lambda *args: sizes.append((args[1].width, args[1].height)) or draw(*args))
    client = connect(page, 1, 2_000_000)
    until(lambda: sizes)
    client.look(image_width=2_000_000, image_height=1)
    until(lambda: sizes[-1][0] > sizes[-1][1])
    assert max(max(size) for size in sizes) <= page.largest


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
