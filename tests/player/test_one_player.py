import pytest
import torch
import yaml
from browsers import listened
from shared import double, longest, peak

from gaussian_swaying.player import session as sessions
from gaussian_swaying.player.film.page import read_bundle, write_film
from gaussian_swaying.player.live_web.page import write_live_web
from gaussian_swaying.simulation.simulation import Simulation

from .conftest import PATIENT, READY, holds, in_turn
from .live_web.conftest import CALM

FRAME = 12
VIEWS = {"film": "film.view", "live": "wind.view", "page": "windPage.view"}


@pytest.fixture
def sources(browser, show, parser, tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "SLOW", 1e9)  # a step is a frame, however slow the machine is
    config = tmp_path / "sheet.yaml"
    config.write_text(yaml.safe_dump(CALM | {"recorder": {"video": False, "renders": []}}))
    make = lambda: Simulation.from_yaml(config, device="cpu")  # noqa: E731
    make().run(tmp_path / "run", FRAME + 1, progress=False)
    files = {"film": tmp_path / "run/film.html", "page": tmp_path / "run/page.html"}
    write_film(tmp_path / "run", files["film"])
    write_live_web(make(), "sheet", files["page"])
    session = sessions.Session(parser, parser.parse_args([f"--config={config}", "--device=cpu"]))
    session.pause()
    addresses = {name: path.as_uri() for name, path in files.items()} | {"live": show(session).url}
    context, opened = browser.new_context(viewport={"width": 64, "height": 64}), {}
    for name, address in addresses.items():
        opened[name] = listened(context.new_page())
        if name == "live":
            opened[name].add_init_script(PATIENT)
        opened[name].goto(address)
    holds(opened["live"], READY)
    for name in ("film", "page"):
        holds(opened[name], f"{VIEWS[name]}.whole")
    yield opened, make, session
    context.close()


def test_nodes_move_alike_from_each_source(sources, tmp_path):
    """At one time of one run: as the file says, within its error of the run, and within 1e-4 of the motion."""
    windows, make, session = sources
    for _ in range(FRAME):
        session.step()
        in_turn(session)
    time = session.snapshot.health.time
    windows["film"].evaluate(f"film.seek({FRAME})")
    windows["page"].evaluate("windPage.tunnel.setPlaying(false), windPage.tunnel.reset()")
    windows["page"].evaluate(f"windPage.advance({FRAME}).then(() => windPage.tunnel.positions())")
    holds(windows["live"], f"wind.tunnel.playback.shown === {time}")
    simulation = make()
    state = simulation.start()
    for _ in range(FRAME):
        state, _ = simulation.advance(state)
    assert state.time == pytest.approx(time)
    scene = simulation.scene
    motion = longest(scene.deformed(state).means - scene.rest().means)  # nodes that carry nothing swing by metres
    expected = state.node_displacement[scene.follow.nodes(state)].double()
    write_film(tmp_path / "run", tmp_path / "film.sway")
    film = read_bundle(tmp_path / "film.sway")
    found = {}
    for name, window in windows.items():
        values = double(window.evaluate(f"Array.from({VIEWS[name]}.drawing.splat.moved.image.data)"))
        found[name] = values.reshape(-1, 4)[: len(expected), :3]
    error = {name: (rows - expected).abs() for name, rows in found.items()}
    assert motion > 0.1
    assert torch.equal(found["film"].float(), torch.from_numpy(film.displacement[FRAME]))
    assert (error["film"] <= film.head["error"] + expected.abs() * 2**-11).all()  # the run has float16
    assert peak(error["live"]) < 1.01 * film.head["error"]
    assert peak(error["page"]) < 1e-4 * motion
