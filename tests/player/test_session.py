import dataclasses
import math
import threading
from types import SimpleNamespace

import pytest
import torch
import yaml
from browsers import reached, until

from gaussian_swaying.config.parser import config_text
from gaussian_swaying.player.pictures import draw
from gaussian_swaying.player.session import WINDOW, Session
from gaussian_swaying.rendering.thinning import DETAIL
from gaussian_swaying.simulation.simulation import Simulation

from .conftest import in_turn, pause


def _position(session):
    return session.snapshot.state.position


def test_it_goes_on_pauses_and_steps(session):
    session.start()
    reached(session, 0.1)
    pause(session)
    now = session.snapshot
    in_turn(session)
    assert session.snapshot is now
    session.step()
    until(lambda: session.snapshot is not now)
    in_turn(session)
    assert session.snapshot.number == now.number + 1
    session.pause(False)
    until(lambda: session.snapshot.number > now.number + 2)
    assert session.problem is None


def test_gaussians_much_smaller_than_a_pixel_are_thinned(session):
    before = session.simulation
    session._change({"solver.dx": 0.3})
    assert session.simulation is not before
    for simulation in (before, session.simulation):
        assert simulation.painter.renderer.detail == DETAIL
    assert Simulation.from_settings(session.parser, session.settings, device="cpu").painter.renderer.detail == 0


def test_it_does_the_same_as_a_loop_over_frames(parser, settings, session, monkeypatch):
    """Not paced or shortened, a session computes the frames of the simulation, bit for bit."""
    monkeypatch.setattr("gaussian_swaying.player.session.SLOW", math.inf)
    session.pause()
    session.start()
    for _ in range(3):
        number = session.snapshot.number
        session.step()
        until(lambda number=number: session.snapshot.number > number)
    frames = list(Simulation.from_settings(parser, settings).frames(4))
    assert torch.equal(_position(session), frames[-1].state.position)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({"wind.flow": [0.0, 3.0, 0.0]}, lambda s: s.wind.flows.tolist() == [[0, 3, 0]]),
        ({"wind.modulations": []}, lambda s: len(s.wind.modulations) == 0),
        ({"aero.C_D": 0.7}, lambda s: float(s.aero.C_D) == pytest.approx(0.7)),
        ({"material.E": 2e4}, lambda s: float(s.scene.points.youngs_modulus.amax()) == pytest.approx(2e4)),
        ({"solver.gravity": [0.0, 0.0, -1.0]}, lambda s: s.solver.gravity == (0, 0, -1)),
        ({"solver.damping": 2.5}, lambda s: s.solver.damping == 2.5),
        ({"shader": None}, lambda s: s.painter.shader is None),
        ({"background": [0.0, 0.5, 0.0]}, lambda s: s.painter.background.tolist() == [0, 0.5, 0]),
    ],
)
def test_what_changes_in_motion(session, values, found):
    session.start()
    reached(session, 0.05)
    simulation, time_before = session.simulation, session.snapshot.health.time
    session.change(values)
    until(lambda: found(session.simulation))
    until(lambda: session.snapshot.health.time > time_before)
    assert session.simulation is simulation
    assert session.problem is None


def test_another_grid_starts_anew_and_the_same_grid_goes_on(session):
    session.start()
    reached(session, 0.1)
    session.pause()
    session.change({"solver.dx": 0.15})
    until(lambda: session.snapshot.simulation.solver.dx == 0.15)
    assert session.snapshot.health.time == 0.0
    session.pause(False)
    reached(session, 0.1)
    before, simulation = session.snapshot.health.time, session.simulation
    session.change({"solver.boundaries": []})  # let go
    until(lambda: session.snapshot.simulation is not simulation)
    assert session.snapshot.health.time >= before
    low = _position(session)[:, 2].mean()
    until(lambda: _position(session)[:, 2].mean() < low - 0.1)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"material.E": -1.0}, "`material.E`|`edits.E`"),
        ({"solver.dx": 0.0}, "`dx`"),
        ({"wind.speeds": 3}, "speeds"),
        ({"wind.flow": "fast"}, "flow"),
    ],
)
def test_what_cannot_be_is_told_and_changes_nothing(session, values, message):
    session.start()
    before = session.yaml()
    session.change(values)
    until(lambda: session.problem is not None)
    assert any(part.strip("`") in session.problem for part in message.split("|"))
    assert "\n" not in session.problem
    assert session.yaml() == before
    number = session.snapshot.number
    until(lambda: session.snapshot.number > number)  # it goes on


def test_what_diverges_is_told_and_reset_heals_it(session):
    session.start()
    session.change({"wind.flow": [1e4, 0.0, 0.0]})
    until(lambda: session.broken)
    assert "wind" in session.problem
    number = session.snapshot.number
    in_turn(session)
    assert session.snapshot.number == number
    session.change({"wind.flow": [1.0, 0.0, 0.0]})
    session.reset()
    reached(session, 0.1)
    assert not session.broken
    assert session.problem is None


def test_reset_goes_back_to_rest_and_keeps_what_was_changed(session):
    rest = _position(session).clone()
    session.start()
    session.change({"material.E": 2e4, "solver.damping": 3.0})
    until(lambda: session.settings.solver.damping == 3.0 and session.snapshot.health.time > 0.1)
    assert not torch.equal(_position(session), rest)
    session.pause()  # or its time at rest passes between two looks
    session.reset()
    until(lambda: session.snapshot.health.time == 0)
    assert torch.equal(_position(session), rest)
    session.pause(False)
    reached(session, 0.05)
    assert float(session.simulation.scene.points.youngs_modulus.amax()) == pytest.approx(2e4)
    assert session.simulation.solver.damping == 3.0


def _stiffness(session):
    return float(session.simulation.scene.points.youngs_modulus.amax())


def test_restore_brings_pins_and_material_back(session):
    first, rest, stiffness = session.yaml(), _position(session).clone(), _stiffness(session)
    session.start()
    session.change({"solver.boundaries": []})
    until(lambda: len(session.simulation.solver.bound.boundaries) == 0)
    session.change({"material.E": 2e4, "wind.flow": [0.0, 1.0, 0.0], "wind.modulations": [], "shader": None})
    until(lambda: session.settings.material.E == 2e4)
    changed = session.yaml()
    session.pause()
    session.restore()
    until(lambda: session.revision == 1)
    assert session.yaml() == first
    assert len(session.simulation.solver.bound.boundaries) == 1
    assert _stiffness(session) == stiffness
    assert len(session.simulation.wind.modulations) == 2
    assert session.simulation.painter.shader is not None
    assert torch.equal(_position(session), rest)
    session.undo()
    until(lambda: session.revision == 2)
    assert session.yaml() == changed
    assert _stiffness(session) == pytest.approx(2e4)


def test_undo_takes_the_last_change_back_in_motion(session, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.player.session.ONE_CHANGE", 100.0)
    session.start()
    first, stiffness = session.yaml(), _stiffness(session)
    for damping in (1.0, 2.0, 3.0):  # as a slider that is dragged: one change
        session.change({"solver.damping": damping})
        until(lambda damping=damping: session.settings.solver.damping == damping)
    session.change({"material.E": 2e4})
    until(lambda: session.changes == 2)
    simulation, before = session.simulation, session.snapshot.health.time
    session.undo()
    until(lambda: session.changes == 1)
    assert _stiffness(session) == pytest.approx(stiffness)
    assert session.settings.solver.damping == 3.0
    session.undo()
    session.undo()
    session.undo()  # there is nothing left
    until(lambda: session.changes == 0)
    until(lambda: session.snapshot.health.time > before)
    assert session.yaml() == first
    assert session.simulation is simulation
    monkeypatch.setattr("gaussian_swaying.player.session.ONE_CHANGE", 0.0)
    for damping in (1.0, 2.0):
        session.change({"solver.damping": damping})
        until(lambda damping=damping: session.settings.solver.damping == damping)
    until(lambda: session.changes == 2)


def test_undo_heals_what_diverged_and_forgets_what_was_refused(session):
    session.start()
    session.change({"material.E": -1.0})
    until(lambda: session.revision == 1)
    assert session.problem is not None
    assert session.changes == 0
    session.change({"wind.flow": [1e4, 0.0, 0.0]})
    until(lambda: session.broken)
    session.undo()
    until(lambda: not session.broken and session.snapshot.health.time > 0.05)
    assert session.problem is None
    assert session.simulation.wind.flows.norm() < 100


def test_material_of_parts_is_that_of_a_run(parser, settings, tmp_path):
    file = tmp_path / "edited.yaml"
    edit = {"time": 0.06, "E": 5e4}
    file.write_text(yaml.safe_dump(yaml.safe_load(config_text(parser, settings)) | {"edits": [edit]}))
    session = Session(parser, parser.parse_args(["--config", str(file), "--device=cpu"]))

    assert _stiffness(session) < 1e4
    session.start()
    until(lambda: _stiffness(session) == pytest.approx(5e4))
    session.change({"material.E": 2e4})
    until(lambda: session.settings.material.E == 2e4)
    until(lambda: session.snapshot.health.time > 0.15 and _stiffness(session) == pytest.approx(5e4))
    session.close()
    assert session.problem is None


def test_the_saved_configuration_is_that_of_the_session(parser, session, tmp_path):
    session.change({"wind.flow": [1.0, 2.0, 0.5], "material.E": 1.2e4, "solver.damping": 0.5})
    session.start()
    until(lambda: session.settings.solver.damping == 0.5)
    file = tmp_path / "live.yaml"
    file.write_text(session.yaml())
    again = Simulation.from_yaml(file, device="cpu")
    assert again.wind.flows.tolist() == [[1, 2, 0.5]]
    assert float(again.scene.points.youngs_modulus.amax()) == pytest.approx(1.2e4)
    assert again.solver.damping == 0.5
    assert yaml.safe_load(file.read_text())["solver"]["dx"] == 0.1


def test_a_pull_moves_what_it_holds_and_lets_go(session):
    session.change({"wind.flow": [0.0, 0.0, 0.0], "wind.modulations": [], "solver.gravity": [0.0, 0.0, 0.0]})
    session.start()
    session.grab([1.2, 0.0, 0.4])
    until(lambda: session.pulls)
    session.drag([1.2, 0.3, 0.4])
    corner = session.snapshot.state.position[:, 0].argmax()
    until(lambda: _position(session)[corner, 1] > 0.2)
    session.let_go()
    until(lambda: not session.pulls)
    assert len(session.simulation.custom_forces) == 0


@pytest.mark.parametrize(("speed", "step", "expected"), [(0.2, 0.03, 0.2), (1.0, 0.03, 1.0), (1.0, 0.08, 0.5)])
def test_slow_motion_is_slower(session, monkeypatch, speed, step, expected):
    now = [0.0]

    def takes_time(state):
        now[0] += step
        before = session.snapshot.health
        return state, dataclasses.replace(before, time=before.time + session.simulation.frame_dt)

    def waits(condition, seconds):
        now[0] += seconds

    clock = SimpleNamespace(perf_counter=lambda: now[0], monotonic=lambda: now[0])
    monkeypatch.setattr("gaussian_swaying.player.session.time", clock)
    monkeypatch.setattr(session.simulation.stepper, "advance", takes_time)
    monkeypatch.setattr(session._wake, "wait_for", waits)
    session.pace(speed)
    while now[0] < 1.5 * WINDOW:  # the first steps, before which nothing was waited for, are forgotten
        session._advance(single=False)
    assert session.simulation.frame_dt == pytest.approx(0.04)
    assert session.rate() == pytest.approx(expected)


def test_steps_get_shorter_where_they_take_long(parser, settings, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.player.session.SLOW", 0.0)
    session = Session(parser, settings).start()
    until(lambda: session.simulation.frame_dt < 0.01)
    session.close()
    assert session.simulation.frame_dt >= settings.frame_dt / 32


def test_steps_of_few_substeps_stay_as_long(session, settings, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.player.session.SLOW", 0.0)
    monkeypatch.setattr("gaussian_swaying.player.session.FEW", 10**6)
    session._advance(single=True)
    assert session.simulation.frame_dt == settings.frame_dt


@pytest.mark.gpu
def test_on_a_gpu_it_is_changed_and_drawn_at_the_same_time(parser, settings):
    settings.device = "cuda"
    session = Session(parser, settings).start()
    camera = session.simulation.painter.camera_at(0)
    pictures, stop = [], threading.Event()

    def watch():
        number = -1
        while not stop.is_set():
            snapshot = session.wait(number, 0.05)
            number = snapshot.number
            with session.lock:
                pictures.append(draw(snapshot, camera))

    watchers = [threading.Thread(target=watch) for _ in range(2)]
    for watcher in watchers:
        watcher.start()
    try:
        until(lambda: session.snapshot.health.time > 0.5, 100)
        for values in (
            {"wind.flow": [0.0, 5.0, 0.0]},
            {"material.E": 2e4},
            {"solver.damping": 1.0},
            {"solver.dx": 0.15},
        ):
            before = session.snapshot.number
            session.change(values)
            until(lambda before=before: session.snapshot.number > before + 15, 100)
        session.grab([1.0, 0.0, 0.4])
        before = session.snapshot.number
        until(lambda: session.snapshot.number > before + 15, 100)
        session.let_go()
    finally:
        stop.set()
        for watcher in watchers:
            watcher.join()
        session.close()
    assert session.problem is None
    assert len(pictures) > 50
    assert abs(pictures[0].astype(int) - pictures[-1].astype(int)).max() > 30
    assert torch.isfinite(session.snapshot.state.position).all()


def test_computed_air_keeps_the_length_of_its_frames(parser, request, monkeypatch):
    monkeypatch.setattr("gaussian_swaying.player.session.SLOW", 0.0)
    config = request.config.rootpath / "configs/sim/flag_in_air.yaml"
    small = [f"--config={config}", "--scene.generator.init_args.spacing=0.05", "--solver.dx=0.1", "--air.cells=24"]
    session = Session(parser, parser.parse_args(small)).start()
    try:
        until(lambda: session.snapshot.number > 2)
        assert session.simulation.frame_dt == 0.04
        session.change({"wind.flow": [3.0, 0.0, 0.0]})
        until(lambda: session.simulation.wind.flows.tolist() == [[3.0, 0.0, 0.0]])
        assert session.snapshot.health.time > 0
        session.change({"frame_dt": 0.02})
        until(lambda: session.simulation.frame_dt == 0.02 and session.snapshot.number > 2)
        assert session.problem is None
    finally:
        session.close()


def test_a_step_that_is_under_way_does_not_lower_the_rates(session, monkeypatch):
    now = 100.0
    monkeypatch.setattr("gaussian_swaying.player.session.time", SimpleNamespace(perf_counter=lambda: now))
    session._steps.extend((now - 1.03 + 0.04 * k, 0.04 * k) for k in range(26))  # the last one 0.03 s ago
    assert session.rate() == pytest.approx(1.0, abs=0.02)
    session._steps.clear()
    session._steps.extend((now - 1.5 + 0.04 * k, 0.04 * k) for k in range(26))  # and 0.5 s ago: it is late
    assert session.rate() == pytest.approx(1.0 / 1.46, abs=0.03)
