"""The messages with which a browser draws a session."""

import json
from dataclasses import replace

import numpy as np
import torch
from browsers import reached
from shared import EYE, double

from gaussian_swaying.gaussians.parts import ROLES
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.rendering.tints import by_role
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.viewer.film.page import message, of_steps, pack_splats
from gaussian_swaying.viewer.film.recorded import STEPS, film_without_frames
from gaussian_swaying.viewer.session import Session
from gaussian_swaying.viewer.streams import (
    colour_message,
    drawable,
    film_from,
    look_message,
    scene_message,
    state_message,
)


def read(raw):
    """Head and bytes of a message."""
    size = int.from_bytes(raw[:4], "little")
    return json.loads(raw[4 : 4 + size]), raw[4 + size :]


def nodal(raw):
    """The displacement in the message of a state, as the page reads it."""
    head, rest = read(raw)
    near = np.frombuffer(rest[: 6 * head["nodes"]], "<i2").reshape(-1, 3)
    return of_steps(near, np.frombuffer(rest[6 * head["nodes"] :], "<i4").reshape(-1, 4), head["step"])


def test_a_state_is_the_displacement_of_the_nodes(session):
    session.start()
    reached(session, 0.1)
    session.pause()
    snapshot = session.wait(-1, 0)
    scene, moved = snapshot.simulation.scene, snapshot.simulation.scene.follow.nodal(snapshot.state).numpy()
    raw = state_message(snapshot, True)
    head, _ = read(raw)
    assert head == {
        "kind": "state",
        "motion": 1,
        "time": snapshot.health.time,
        "nodes": len(moved),
        "step": (size := scene.size * scene.frame.metres_per_unit) / STEPS,
        "ended": True,
    }
    assert np.abs(nodal(raw) - moved).max() <= 0.501 * size / STEPS
    assert np.abs(moved).max() > 0.01 * size
    assert 6 * len(moved) < len(raw) < 6 * len(moved) + 16 * len(moved) // 20 + 200


def test_a_scene_is_a_film_without_frames(session):
    snapshot = session.snapshot
    film = film_without_frames(snapshot.simulation, snapshot.state, "scene")
    head, rest = read(scene_message(snapshot, EYE))
    moving, still = pack_splats(film, moving=True), pack_splats(film, moving=False)
    assert head["head"] == film.head
    assert (head["moving"], head["still"]) == (len(moving), len(still))
    assert rest == moving + still + film.order.astype("<u4").tobytes() + film.stencils.astype("<u4").tobytes()


def test_the_camera_finds_the_gaussians_in_any_scene(parser, settings, tmp_path):
    """Places in the axes of the browser's camera are those of the film: of a scene in other units, with another up."""
    splat = tmp_path / "flag.ply"
    cloud = FlagScene(width=0.6, height=0.6, spacing=0.05).generate()
    turned = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    write_ply(splat, replace(cloud, means=7 * cloud.means @ turned.T + 3))
    given = ["--scene.generator=null", f"--scene.ply={splat}", "--scene.up=[0,-1,0]", "--scene.metres_per_unit=0.25"]
    given = [*given, "--solver.boundaries=[]", "--solver.dx=0.2", "--device=cpu"]
    session = Session(parser, parser.parse_args(given))
    snapshot = session.snapshot
    simulation = snapshot.simulation
    film = film_without_frames(simulation, snapshot.state, "scene")
    turn = double([[0.0, 0, -1], [0, -1, 0], [-1, 0, 0]])
    world = film_from(simulation.scene, turn)
    seen = simulation.scene.model.means.double()[film.order] @ turn.T
    assert torch.allclose(seen @ world[:3, :3].T + world[:3, 3], torch.from_numpy(film.position).double(), atol=1e-5)
    head, _ = read(scene_message(snapshot, turn))
    assert np.allclose(np.array(head["world"]).reshape(4, 4).T, world.numpy(), atol=1e-12)  # three.js has columns


def test_what_a_browser_cannot_draw_is_drawn_here(parser, settings, session):
    assert drawable(session.snapshot)
    session.settings.shader = None
    for specular, good in ((0.2, False), (0.0, True)):
        light = {"light": [0.0, -1.0, 0.0], "specular": specular}
        session._change({"shader": {"class_path": "DiffuseShader", "init_args": light}})
        assert drawable(session.snapshot) is good
    session._change({"shader": None})
    assert drawable(session.snapshot)
    session._change({"solver.formulation": "updated"})
    assert not drawable(session.snapshot)


def test_a_message_has_a_head_and_bytes():
    assert read(message({"kind": "ü"}, b"ab", b"c")) == ({"kind": "ü"}, b"abc")


def test_a_gpu_is_read_in_turn(session, monkeypatch):
    """Another thread may record a graph; on a CPU nobody waits."""
    snapshot, taken = session.snapshot, []
    monkeypatch.setattr(type(snapshot.simulation.turn), "__enter__", lambda turn: taken.append(turn))
    monkeypatch.setattr(type(snapshot.simulation.turn), "__exit__", lambda turn, *error: None)
    for device, turns in (("cpu", 1), ("cuda", 5)):  # one for the camera
        monkeypatch.setattr(type(snapshot.simulation), "device", torch.device(device))
        taken.clear()
        assert drawable(snapshot)
        state_message(snapshot, False)
        look_message(snapshot.simulation)
        scene_message(snapshot, EYE)
        assert taken == [snapshot.simulation.turn] * turns


def test_other_colours_are_those_of_the_film_with_the_tints_of_roles(session):
    """What became soft again has the colour that the scene brought."""
    simulation = session.simulation
    film = film_without_frames(simulation, session.snapshot.state, "scene")
    own = film.color[np.argsort(film.order), :3]
    index, roles = torch.tensor([7, 900, 3]), torch.tensor([ROLES.index(role) for role in ("soft", "held", "still")])
    head, rest = read(colour_message(simulation, index, roles))
    assert head == {"kind": "colours", "count": 3}
    assert np.frombuffer(rest[:12], "<u4").tolist() == index.tolist()
    colours = np.frombuffer(rest[12:], np.uint8).reshape(3, 3)
    assert colours[0].tolist() == own[7].tolist()
    expected = 255 * by_role(torch.tensor(own[index] / 255.0), roles).numpy()
    assert np.abs(colours - expected).max() <= 1
    assert np.abs(colours - own[index]).max(1).tolist()[1:] > [20, 20]
