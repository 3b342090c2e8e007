"""The server of the live page: what browsers get, and what they may ask, by browsers without a browser."""

import gzip
import json
import socket
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

import numpy as np
import pytest
import torch
import yaml
from aiohttp import WSServerHandshakeError
from browsers import reached, until
from shared import value_error

from gaussian_swaying.gaussians.formats import export_cloud
from gaussian_swaying.gaussians.parts import ROLES
from gaussian_swaying.player import server as server_module
from gaussian_swaying.player.film.page import of_steps, read_bundle
from gaussian_swaying.player.film.recorded import STEPS, film_without_frames
from gaussian_swaying.player.server import AHEAD, Door, Server, check_address, drawable, state_message
from gaussian_swaying.player.session import Session
from gaussian_swaying.rendering.tints import by_role
from gaussian_swaying.scenes.procedural import FlagScene

from .conftest import LOOK, in_turn, pause


def _open(address, data=None, **headers):
    try:
        answer = urllib.request.urlopen(urllib.request.Request(address, data, headers=headers), timeout=60)
    except urllib.error.HTTPError as error:
        answer = error
    return answer.status, answer.headers, answer.read()


# ---- who may open it


@pytest.fixture
def open_page(show):
    return show(host="0.0.0.0", names=["Wind.Example"])


def test_other_websites_in_the_same_browser_are_refused(page, connect):
    for headers in ({"Origin": "https://evil.example"}, {"Host": "evil.example"}, {"Host": "[1"}, {"Host": ""}):
        for path in ("/", "/load?name=a.ply"):
            assert _open(page.url + path, b"x" if "load" in path else None, **headers)[0] in (400, 403)
    assert _open(page.url, Origin=page.url)[0] == 200
    assert page.url_elsewhere is None
    with pytest.raises(WSServerHandshakeError, match="403"):
        connect(page, origin="https://evil.example")


def test_the_page_is_shown_in_no_frame_and_serves_no_files(page):
    headers = _open(page.url)[1]
    assert (headers["X-Frame-Options"], headers["X-Content-Type-Options"]) == ("DENY", "nosniff")
    own = page.url.split("//")[1]
    policy = f"frame-ancestors 'none'; connect-src 'self' ws://{own} wss://{own} blob: data:"
    assert headers["Content-Security-Policy"] == policy
    paths = ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/save/..%2fserver.py", "/save/x")
    for path in (*paths, "/" + "a" * 5000):
        assert _open(page.url + path)[0] == 404


@pytest.mark.parametrize(
    ("name", "good"),
    [
        ("localhost:80", True),
        ("127.0.0.1", True),
        (socket.gethostname(), True),
        ("mine.example:8080", True),
        ("MINE.example", True),
        ("192.0.2.7:8080", True),
        ("192.0.2.8:8080", False),
        ("evil.example", False),
        ("mine.example.evil.example", False),
        ("0.0.0.0:8080", False),
        ("", False),
        ("[::1", False),
        ("user@localhost@evil.example", False),
    ],
)
def test_names_are_on_a_list(name, good):
    door = Door("0.0.0.0", ["Mine.example"])
    refusal = door.refusal({"Host": name}, [door.token], "192.0.2.7")
    assert (refusal is None) is good
    other = {"Host": name, "Origin": "http://evil.example"}
    assert door.refusal(other, [door.token], "192.0.2.7") is not None


def test_a_page_for_other_computers_needs_the_token_of_its_link(open_page, connect):
    address, token = open_page.url.split("/?token=")
    assert open_page.url_elsewhere == f"http://{socket.gethostname()}:{open_page.port}/?token={token}"
    assert len(token) > 20
    assert Door("0.0.0.0").token != token
    assert b"token" in _open(address)[2]
    for wrong in ("", "/?token=" + token[:-1], "/?token=%C3%A9"):
        assert _open(address + wrong)[0] == 403
    status, headers, _ = _open(open_page.url)
    assert status == 200
    cookie = headers["Set-Cookie"].split(";")[0]
    assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in headers["Set-Cookie"].split(";")}
    assert _open(address, Cookie=cookie)[0] == 200
    assert _open(address, Cookie=cookie[:-1])[0] == _open(address, Cookie="=;;bad=")[0] == 403
    assert _open(open_page.url, Host="wind.example")[0] == 200
    assert _open(open_page.url, Host="evil.example")[0] == 403
    with pytest.raises(WSServerHandshakeError, match="403"):
        connect(open_page)
    connect(open_page, headers={"Cookie": f"a=b; {cookie}"})


@pytest.mark.parametrize(("host", "port", "field"), [("127.0.0.1", 70000, "--port"), ("10.99.99.99", 8080, "--host")])
def test_an_address_that_cannot_be_is_refused(host, port, field):
    with value_error(field):
        check_address(host, port)


def test_the_next_free_port_is_taken(page):
    other = Server(port=page.port)
    assert other.port > page.port
    assert _open(other.url)[0] == 200
    other.close()


def test_noise_is_no_traceback(page, capfd):
    for noise in (b"\x16\x03\x01\x00garbage\r\n\r\n", b"GET\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", page.port), timeout=5) as raw:
            raw.sendall(noise)
    assert _open(page.url)[0] == 200
    assert "Traceback" not in "".join(capfd.readouterr())


def test_closing_ends_all_threads(parser, settings):
    before = set(threading.enumerate())
    session = Session(parser, settings)
    page = Server(port=8450).show(session)
    session.start()
    page.close()
    session.close()
    until(lambda: not {t.name for t in set(threading.enumerate()) - before} & {"server", "follow", "simulation"})


@pytest.mark.parametrize("zipped", [False, True])
def test_the_page_starts_the_program(page, zipped):
    text = _open(page.url)[2].decode()
    assert text.index('<script src="player.js">') < text.index("watchWind();")
    _, headers, body = _open(page.url + "/player.js?x=1", **({"Accept-Encoding": "gzip"} if zipped else {}))
    assert (headers["Content-Encoding"] == "gzip") is zipped
    assert headers["Content-Type"].startswith("text/javascript")
    assert (gzip.decompress(body) if zipped else body).startswith(b"// Made by tools/player")


# ---- what a browser gets


def _nodal(head):
    near = np.frombuffer(head["rest"][: 6 * head["nodes"]], "<i2").reshape(-1, 3)
    return of_steps(near, np.frombuffer(head["rest"][6 * head["nodes"] :], "<i4").reshape(-1, 4), head["step"])


def test_a_state_is_the_displacement_of_the_nodes(page, connect):
    client, session = connect(page), page.session
    reached(session, 0.1)
    pause(session)
    snapshot = session.snapshot
    scene, moved = snapshot.simulation.scene, snapshot.simulation.scene.follow.nodal(snapshot.state).numpy()
    size = scene.size * scene.frame.metres_per_unit
    head = client.wait("state", ended=True, time=snapshot.health.time)
    assert (head["motion"], head["nodes"], head["step"]) == (1, len(moved), size / STEPS)
    assert np.abs(_nodal(head) - moved).max() <= 0.501 * size / STEPS
    assert np.abs(moved).max() > 0.01 * size
    assert 6 * len(moved) <= len(head["rest"]) < 6 * len(moved) + 16 * len(moved) // 20


def test_the_scene_comes_once_as_a_bundle_and_then_states_that_rise(page, connect, tmp_path):
    client, session = connect(page), page.session
    client.wait("scene")
    (tmp_path / "scene.sway").write_bytes(_open(page.url + "/scene.sway")[2])
    there, film = (
        read_bundle(tmp_path / "scene.sway"),
        film_without_frames(session.simulation, session.snapshot.state, ""),
    )
    own = {"title": "", "frame_dt": 0.0}  # a step may be a part of a frame
    assert there.head | own == film.head | own
    assert np.array_equal(there.position, film.position)
    times = []
    while len(times) < 6:
        head = client.get()
        assert head["kind"] != "scene"
        if head["kind"] == "state":
            times.append(head["time"])
    assert times == sorted(set(times))


def test_who_confirms_nothing_gets_no_more(page, connect):
    client = connect(page)
    count = 0
    while count < AHEAD:
        count += client.get(confirm=False)["kind"] == "state"
    until(lambda: page.session.snapshot.health.time > 0.15)
    end = time.monotonic() + 0.7
    while time.monotonic() < end:
        try:
            assert client.get(0.3, confirm=False)["kind"] in ("figures", "panel", "painting")
        except TimeoutError:
            break
    before = page.session.snapshot.health.time
    client.confirm()
    assert client.wait("state")["time"] >= before  # none of those in between was sent


def test_a_browser_that_draws_gets_no_pictures(page, connect):
    """Until it shows what it cannot draw, or wishes so, or is slow."""
    client = connect(page)
    client.wait("state")
    client.wait("figures", lambda head: head.get("pictures") == 30)
    for shown in ({"show": "normal", "server": False}, {"show": "color", "server": True}):
        client.say("shown", hidden=False, **shown)
        picture = client.wait("picture")
        assert picture["rest"].startswith(b"\xff\xd8")
        client.say("shown", hidden=False, show="color", server=False)
        client.wait("scene")
        client.wait("state")
    for _ in range(10):
        assert client.get()["kind"] != "picture"


def test_pictures_come_while_a_scene_is_made_once_for_all(page, connect, monkeypatch):
    made, begun = threading.Event(), []

    def slow(*given):
        begun.append(given)
        assert made.wait(60)
        if len(begun) == 1:
            raise ValueError("no memory")
        return film_without_frames(*given)

    monkeypatch.setattr(server_module, "film_without_frames", slow)
    client, other = connect(page), connect(page)
    for each in (client, other, client):
        each.wait("picture")
    assert len(begun) == 1
    made.set()
    for each in (client, other):  # the notice comes before the scene or after it
        missing = {"scene", "state", "A picture could not be drawn: no memory"}
        while missing:
            head = each.get()
            missing -= {head["kind"], head.get("notice")}
    assert len(begun) == 2


def test_who_looks_away_gets_nothing_to_draw(page, connect):
    client = connect(page)
    client.wait("state")
    client.say("shown", hidden=True, show="color", server=False)
    number = page.session.snapshot.number
    until(lambda: page.session.snapshot.number > number + 2)
    seen = [client.get()["kind"] for _ in range(6)]
    assert seen[-3:] == ["figures"] * 3


def test_changes_come_as_what_they_are(page, connect):
    client, session = connect(page), page.session
    first = client.wait("state")
    session.change({"background": [0.0, 0.0, 1.0]})
    assert client.wait("look")["background"] == [0.0, 0.0, 1.0]
    client.say("reset")
    client.wait("state", motion=first["motion"] + 1)
    client.say("run", on=False, speed=0.5)
    client.wait("state", ended=True)
    client.wait("figures", paused=True, speed=0.5)
    in_turn(session)
    number = session.snapshot.number
    client.say("step")
    until(lambda: session.snapshot.number == number + 1)
    client.say("reset")
    paused = client.wait("state", motion=first["motion"] + 2)
    assert (paused["time"], paused["ended"]) == (0.0, True)
    session.change({"solver.dx": 0.09})
    client.wait("scene")
    last = client.wait("state", ended=True)
    assert (last["time"], last["motion"]) == (0.0, paused["motion"] + 1)


def test_only_colours_that_changed_are_sent(page, connect):
    client, session = connect(page), page.session
    pause(session)
    client.wait("state", ended=True)
    film = film_without_frames(session.simulation, session.snapshot.state, "")
    roles = torch.zeros(len(film.order), dtype=torch.uint8)
    for changed, role in (([3, 5, 9], "held"), ([5], "still"), ([3, 9], "soft")):
        roles = roles.clone()
        roles[changed] = ROLES.index(role)
        page.painting.roles = roles
        head = client.wait("colours")
        places = np.frombuffer(head["rest"][: 4 * len(changed)], "<u4")
        colours = np.frombuffer(head["rest"][4 * len(changed) :], np.uint8).reshape(-1, 3)
        assert sorted(film.order[places]) == changed
        wanted = 255 * by_role(torch.tensor(film.color[places, :3] / 255.0), roles[film.order[places]]).numpy()
        assert np.abs(colours - wanted).max() <= 1
    page.painting.roles = None
    assert client.wait("colours")["count"] == 1
    page.painting.roles = roles
    session.change({"solver.dx": 0.12})
    client.wait("scene")
    assert client.wait("colours")["count"] == 1  # which the new scene did not have


def test_what_a_browser_cannot_draw_is_drawn_here(session):
    assert drawable(session.snapshot)
    session.settings.shader = None
    light = {"light": [0.0, -1.0, 0.0]}
    session._change({"shader": {"class_path": "DiffuseShader", "init_args": light}})
    assert drawable(session.snapshot)
    session.snapshot.simulation.painter.shader = torch.nn.Identity()
    assert not drawable(session.snapshot)
    session._change({"solver.formulation": "updated"})
    assert not drawable(session.snapshot)


def test_a_gpu_is_read_in_turn(session, monkeypatch):
    snapshot, taken = session.snapshot, []
    monkeypatch.setattr(type(snapshot.simulation.turn), "__enter__", lambda turn: taken.append(turn))
    monkeypatch.setattr(type(snapshot.simulation.turn), "__exit__", lambda turn, *error: None)
    for device, turns in (("cpu", 0), ("cuda", 2)):
        monkeypatch.setattr(type(snapshot.simulation), "device", torch.device(device))
        taken.clear()
        assert drawable(snapshot)
        state_message(snapshot, False)
        assert taken == [snapshot.simulation.turn] * turns


def test_no_camera_makes_a_picture_larger_than_the_limit(page, connect, monkeypatch):
    sizes, draw = [], server_module.draw
    monkeypatch.setattr(
        server_module, "draw", lambda *args: sizes.append((args[1].width, args[1].height)) or draw(*args)
    )
    client = connect(page, looks=False)
    client.say("shown", hidden=False, show="color", server=True)
    for size in ([1, 16384], [16384, 1]):
        client.say("view", **(LOOK | {"size": size}))
        client.wait("picture")
    until(lambda: sizes[-1][0] > sizes[-1][1] or client.wait("picture") is None)
    assert max(max(size) for size in sizes) <= page.largest


@pytest.mark.slow
def test_a_client_that_reads_nothing_slows_nobody(page, connect):
    page.largest = 1000
    slow, quick = connect(page), connect(page)
    for client in (slow, quick):
        client.say("shown", hidden=False, show="color", server=True)
    seen = set()
    while len(seen) < 12:
        seen.add(quick.wait("picture")["time"])
    assert page.session.problem is None
    slow.close()
    until(lambda: len(page.clients) == 1)


@pytest.mark.slow
def test_thirty_browsers_get_states_and_a_change_shows_soon(page, connect):
    clients = [connect(page) for _ in range(30)]
    for client in clients:
        client.wait("state")
    clients[0].say("set", name="material.E", value=2e4)
    for client in clients:
        client.control("material.E", lambda value: value == 2e4)
    assert page.session.problem is None


# ---- what it may ask


def test_controls_change_the_session_for_all(page, connect):
    session = page.session
    client, other = connect(page), connect(page)
    first = session.yaml()
    client.say("set", name="free", value=None)
    until(lambda: session.settings.solver.boundaries == [])
    client.say("set", name="wind.speed", value=1.0)
    other.control("wind.speed", lambda value: value == pytest.approx(1.0, abs=1e-3))
    other.wait("figures", undo=2)
    other.say("undo")
    client.control("wind.speed", lambda value: value == pytest.approx(6.18, abs=0.01))
    client.say("restore")
    until(lambda: session.yaml() == first)


def test_a_pull_is_answered_with_its_place(page, connect):
    client, session = connect(page), page.session
    pause(session)
    scene = session.simulation.scene
    eye = [0.0, -3.0, 0.0]
    client.say("grab", eye=eye, ray=[0.0, 0.0, 1.0], wide=0.01, token=1)
    assert client.wait("grabbed") == {"kind": "grabbed", "token": 1, "place": None}
    client.say("grab", eye=eye, ray=[0.0, 1.0, 0.0], wide=0.01, token=2)
    place = client.wait("grabbed", token=2)["place"]
    assert np.abs(place).max() < 0.05 * scene.size
    until(lambda: session.pulls)
    client.say("aim", target=[0.1, 0.0, 0.2])
    until(lambda: session._pull is not None and session._pull.target.tolist() == pytest.approx([0.1, 0.0, 0.2]))
    client.say("release")
    until(lambda: not session.pulls)


HOSTILE = [
    "",
    "[]",
    "null",
    "{",
    "[" * 5000,
    json.dumps({"kind": "no such"}),
    json.dumps({"kind": "set"}),
    json.dumps({"kind": "set", "name": {}, "value": []}),
    json.dumps({"kind": "set", "name": "scene.ply", "value": "/etc/passwd"}),
    json.dumps({"kind": "set", "name": "material.E", "value": "1e5"}),
    '{"kind": "set", "name": "material.E", "value": NaN}',
    '{"kind": "set", "name": "wind.flow", "value": [1e999, 0, 0]}',
    json.dumps({"kind": "run", "on": True, "speed": "fast"}),
    json.dumps({"kind": "view", **LOOK, "size": [10**9, 10**9]}),
    json.dumps({"kind": "view", **LOOK, "fov": 1e9}),
    '{"kind": "view", "matrix": [NaN], "fov": 40, "near": 1, "size": [10, 10]}',
    json.dumps({"kind": "grab", "eye": [0, 0], "ray": [0, 0, 1], "token": 1}),
    json.dumps({"kind": "aim", "target": "there"}),
    json.dumps({"kind": "brush", "path": [[0, 0]] * 100_000, "radius": 1}),
    json.dumps({"kind": "ack", "count": "many", "rate": 1}),
    json.dumps({"kind": "close"}),
]


def test_hostile_messages_are_refused_and_the_page_goes_on(page, connect):
    session = page.session
    client, other = connect(page), connect(page)
    before = session.settings
    for said in HOSTILE:
        client._run(client.socket.send_str(said))
    client._run(client.socket.send_bytes(b"\x00" * 100))
    assert other.wait("figures", lambda head: head["notice"])
    client.wait("state")
    other.wait("state")
    assert session.settings is before
    assert session.problem is None
    client._run(client.socket.send_str("x" * (2 << 20)))  # too long: this connection ends
    until(lambda: len(page.clients) == 1)
    other.wait("state")


# ---- files


def _load(page, name, content):
    return _open(f"{page.url}/load?name={urllib.parse.quote(name)}", content)


def test_a_configuration_is_loaded(page, connect):
    client, session = connect(page), page.session
    given = yaml.safe_load(session.yaml())
    given["wind"]["flow"], given["material"]["E"] = [0.0, 2.5, 0.0], 1.5e4
    before = session.simulation
    assert _load(page, "mine.yaml", yaml.safe_dump(given).encode())[0] == 200
    assert session.simulation is not before
    client.control("wind.speed", lambda value: value == 2.5)
    assert session.settings.material.E == 1.5e4
    assert session.changes == 0
    now = session.simulation
    for content, told in (
        (b"wind: {flows: 3}", "flows"),
        (b"\xff\xfe", "UTF-8"),
        (b"scene: {ply: /none/there.ply}", "load it first"),
        (b"a: " + b"[" * 100, "64 levels"),
    ):
        status, _, answer = _load(page, "bad.yml", content)
        assert (status, told in answer.decode()) == (400, True)
    assert session.simulation is now
    client.wait("figures", loading=None)


def test_configurations_are_not_loaded_where_others_can_open_the_page(open_page):
    address, token = open_page.url.split("?")
    status, _, answer = _open(f"{address}load?name=a.yaml&{token}", b"solver: {dx: 0.2}")
    assert (status, b"other computers cannot open" in answer) == (400, True)


@pytest.mark.parametrize("name", ["flag.ply", "flag.SPZ"])
def test_a_splat_that_is_loaded_tells_how_far_it_is(name, page, tmp_path, monkeypatch):
    """In any format; of the name, which a browser sends, only the ending is used. A saved configuration names it."""
    path = tmp_path / "flag"
    export_cloud(path, FlagScene(width=0.6, height=0.6, spacing=0.05).generate(), format=name[5:].lower())
    told, before = [], page.session.simulation
    tell = page.progress
    monkeypatch.setattr(page, "progress", lambda share, what="": (told.append(share), tell(share, what)))
    assert _load(page, f"../../{name}", path.read_bytes())[0] == 200
    assert page.session.simulation is not before
    assert told[-1] is None
    shares = [share for share in told if share is not None]
    assert shares == sorted(shares)
    assert len(shares) >= 3
    assert f"scene{name[4:].lower()}" in page.session.yaml()
    saved = _open(f"{page.url}/save/live.yaml")[2].decode()
    assert saved.startswith("# Give the splat that you loaded")
    assert yaml.safe_load(saved)["scene"]["ply"] == f"scene{name[4:].lower()}"


def test_a_file_that_is_no_splat_or_too_large_is_refused(page, monkeypatch):
    before = page.session.simulation
    assert _load(page, "a.ply", b"<!doctype html><p>Not found")[0] == 400
    monkeypatch.setattr(server_module, "MOST_LOADED", 1000)
    status, _, answer = _load(page, "a.ply", b"x" * 5000)
    assert (status, b"command line" in answer) == (400, True)
    assert page.session.simulation is before
    assert page._progress is None


def test_a_bar_shows_how_far_a_scene_is_loaded(show, connect):
    server = Server(port=8480, largest=320)
    client = connect(server)
    assert client.wait("figures")["loading"]["what"] == "Loading the scene"
    server.progress(0.35, "Making a draft")
    client.wait("figures", loading={"share": 0.35, "what": "Making a draft"})
    show(server=server)
    client.wait("figures", loading=None)
    client.wait("state")  # for the client that came early, too
