import torch
from browsers import until

from gaussian_swaying.player import session as session_module

from .conftest import READY, holds


def _place(window, track, time, value):
    """The pixel of a time and value of a track."""
    find = """([track, time, value]) => {
        const { timeline } = wind.tunnel.panel, { left, top } = timeline.svg.getBoundingClientRect();
        const index = timeline.tracks.findIndex(({ name }) => name === track);
        return [left + timeline.x(time), top + timeline.y(index, value)];
    }"""
    return window.evaluate(find, [track, time, value])


def _keys(session):
    found = [{k: v for k, v in vars(key).items() if v is not None} for key in session.settings.wind.schedule or ()]
    return found, session.settings.wind.interpolation


def test_keys_are_added_dragged_and_removed_by_mouse_and_the_wind_follows(page, open_window, monkeypatch):
    monkeypatch.setattr(session_module, "ONE_CHANGE", 0.0)  # each is undone on its own
    session, window = page.session, open_window(1300, 900)
    holds(window, READY)
    motion = session.snapshot.motion
    window.get_by_role("button", name="Speed, direction and gusts over time").click()

    def blown(time):
        return session.simulation.wind.mean_flow(torch.tensor(time, dtype=torch.float64)).norm().item()

    window.mouse.dblclick(*_place(window, "speed", 2.0, 6.0))
    until(lambda: len(_keys(session)[0]) == 1)
    window.mouse.dblclick(*_place(window, "speed", 4.0, 18.0))
    until(lambda: len(_keys(session)[0]) == 2)
    keys, interpolation = _keys(session)
    assert interpolation == "linear"
    (first, low), (last, high) = ((key["time"], key["speed"]) for key in keys)
    assert abs(first - 2) < 0.05
    assert abs(last - 4) < 0.05
    assert abs(blown(first) - low) < 0.01
    assert abs(blown((first + last) / 2) - (low + high) / 2) < 0.01
    assert abs(high - 18) < 1
    assert (session.snapshot.motion, session.problem) == (motion, None)  # it goes on
    window.mouse.dblclick(*_place(window, "gusts", 3.0, 2.0))
    until(lambda: len(_keys(session)[0]) == 3)
    assert abs(session.simulation.wind.strength(torch.tensor(9.0).double()).item() - 2) < 0.1
    window.mouse.move(*_place(window, "speed", last, high))
    window.mouse.down()
    window.mouse.move(*_place(window, "speed", 6.0, 12.0), steps=5)
    assert len(session.settings.wind.schedule) == 3  # sent as one change, when it is let go
    changes = session.changes
    window.mouse.up()
    until(lambda: abs(blown(6.1) - 12) < 1)
    assert session.changes == changes + 1
    assert "speed: 1" in session.yaml()
    window.mouse.click(*_place(window, "speed", *_last(session, "speed")), button="right")
    until(lambda: len(_keys(session)[0]) == 2)
    assert abs(blown(9.0) - low) < 0.01
    window.locator("#undo").click()
    until(lambda: abs(blown(9.0) - 12) < 1)
    holds(window, "wind.tunnel.panel.timeline.keys(0).length === 2")
    window.locator('circle[data-key="2,0"]').focus()
    window.keyboard.press("Delete")
    until(lambda: session.simulation.wind.strength(torch.tensor(9.0).double()) == 1)
    window.locator("#dial").focus()
    window.keyboard.press("ArrowUp")  # a steady wind again
    until(lambda: session.settings.wind.schedule is None)
    assert abs(blown(9.0) - blown(0.0)) < 1e-9
    holds(window, "wind.tunnel.panel.timeline.keys(0).length === 0")
    session.change({"wind.flow": [0.0, 0.0, 0.0]})
    until(lambda: blown(0.0) == 0)
    window.mouse.dblclick(*_place(window, "azimuth", 2.0, 90.0))
    window.get_by_text("No key of `schedule` gives `speed`").wait_for()
    holds(window, "wind.tunnel.panel.timeline.keys(1).length === 0")  # a refused key goes away
    assert window.problems == []


def _last(session, name):
    return [(key.time, key[name]) for key in session.settings.wind.schedule if key[name] is not None][-1]
