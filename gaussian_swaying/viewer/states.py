"""Messages for a browser that draws a session itself: the Gaussians once, then the displaced nodes of each state.

A message is the length of its head (uint32, little-endian), the head in JSON, and the bytes that the head describes.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.recording.nodes import split_far
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.rendering.tints import by_role
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import message, pack_splats
from gaussian_swaying.viewer.film.recorded import film_without_frames, look_of
from gaussian_swaying.viewer.session import Snapshot


def drawable(snapshot: Snapshot) -> bool:
    """True if a browser can draw a snapshot: the Gaussians follow nodes, in a light that it knows."""
    shader = snapshot.simulation.painter.shader
    with _turn(snapshot.simulation):
        has_nodes = snapshot.simulation.scene.follow.nodes(snapshot.state) is not None
    return has_nodes and (shader is None or isinstance(shader, DiffuseShader))


@torch.inference_mode()
def scene_message(snapshot: Snapshot, turn: Tensor) -> bytes:
    """The Gaussians at rest and the nodes that move them, as in a film.

    Args:
        snapshot: A snapshot of the scene; see :func:`drawable`.
        turn: Rotation from the scene to the axes of the browser's camera, shape (3, 3), float64.
    """
    simulation = snapshot.simulation
    with _turn(simulation):
        film = film_without_frames(simulation, snapshot.state, "scene")
        world = film_from(simulation.scene, turn)
    moving, still = pack_splats(film, moving=True), pack_splats(film, moving=False)
    sizes = {"moving": len(moving), "still": len(still)}
    head = {"kind": "scene", "head": film.head, **sizes, "world": world.T.flatten().tolist()}
    rest = film.order.astype("<u4").tobytes(), film.stencils.astype("<u4").tobytes()
    return message(head, moving, still, *rest)


def film_from(scene: SimulatedScene, turn: Tensor) -> Tensor:
    """The transformation of places from the axes of the browser's camera to a film, shape (4, 4), float64.

    A film has the object's longest side as its unit, z up and the object's centre as its origin.
    """
    corners = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double()
    size = scene.size * scene.frame.metres_per_unit
    places = scene.frame.point_to_sim(corners @ turn.to(corners)).cpu() / size
    found = torch.eye(4, dtype=torch.float64)
    found[:3, 3] = places[0]
    found[:3, :3] = (places[1:] - places[0]).T
    return found


def look_message(simulation: Simulation) -> bytes:
    """Light and background, where they have changed since the scene."""
    with _turn(simulation):
        return message({"kind": "look", **look_of(simulation.painter)})


@torch.inference_mode()
def colour_message(simulation: Simulation, index: Tensor, roles: Tensor) -> bytes:
    """Other colours of some Gaussians: their indices (uint32), and red, green and blue of each (uint8).

    Args:
        simulation: The simulation.
        index: The Gaussians, shape (M,).
        roles: Their roles, see :func:`~gaussian_swaying.rendering.tints.by_role`, shape (M,).
    """
    with _turn(simulation):
        sh = simulation.scene.model.sh0.detach()
        sh = sh[index.to(sh.device)]
        own = sh_to_color(sh, torch.ones(len(sh), 3, device=sh.device)).clamp(0, 1)
        bytes_of = (by_role(own, roles) * 255).round().to(torch.uint8).numpy(force=True).tobytes()
    return message({"kind": "colours", "count": len(index)}, index.numpy().astype("<u4").tobytes(), bytes_of)


@torch.inference_mode()
def state_message(snapshot: Snapshot, ended: bool) -> bytes:
    """The displacement of the nodes of a state: 6 bytes each, and 16 more for one that moved far.

    Args:
        snapshot: The snapshot.
        ended: Whether no other state follows for now.
    """
    simulation, state = snapshot.simulation, snapshot.state
    scene = simulation.scene
    with _turn(simulation):
        moved = scene.follow.nodal(state)
        assert moved is not None
        values = moved.float().numpy(force=True)
    near, far = split_far(values, 0.5 * scene.size * scene.frame.metres_per_unit)
    head = {
        "kind": "state",
        "motion": snapshot.motion,
        "time": snapshot.health.time,
        "nodes": len(near),
        "ended": ended,
    }
    return message(head, near.astype("<f2").tobytes(), far.astype("<i4").tobytes())


def _turn(simulation: Simulation) -> AbstractContextManager[None]:
    """On a GPU the turn of the thread that reads it, as another may record a graph; a CPU does not have to wait."""
    return simulation.turn if simulation.device.type == "cuda" else nullcontext()


OFF = message({"kind": "off"})
"""Says that the server draws from now on."""
