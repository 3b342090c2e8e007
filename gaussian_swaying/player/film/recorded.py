"""The contents of a film, read from the folder of a run: Gaussians at rest, nodes that move, a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.rotations import quat_multiply, rotation_to_quat
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import Stencil, bspline_weights
from gaussian_swaying.mpm.virtual_nodes import coordinates
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.simulation import RecordedRun, Simulation

FIRST = {"moving": 1 << 11, "still": 1 << 12}
"""Gaussians that move, and that do not, in the first picture."""
PART = 1 << 16
"""Gaussians of a later part: whole rows of the player's textures, as in the first one."""
STEPS = 1 << 15
"""Steps of a displacement in the longest side of the object at rest."""
GRAIN = 1 << 19
"""Steps of a position in it."""
ARM = 1 << 12
"""Steps of an arm in a cell. An error moves the place to and fro, but not the centre, in proportion to the gradient."""
NORMAL = 512
"""Steps of a normal."""


@dataclass(frozen=True)
class Film:
    """A film of N Gaussians and M nodes in K frames.

    First come the L Gaussians that move, then the others. Any first part of either is spread over the whole scene, so
    that some thousands show it already.

    The unit of length is the object's longest side at rest, with z up and the origin at its centre. A place is given in
    cells of the grid, from its first node. A stencil is 27 nodes, those along z next to each other; Gaussians in one
    cell share one, except where parts of it have nodes of their own.

    Attributes:
        head: Further data for the page: sizes, time between frames [s], grid, light, camera, title.
        position: Centres at rest, float32, shape (N, 3).
        arm: Centre of those that move from where they take displacement and gradient [cells], float32, shape (L, 3).
        scale: Logarithm of the standard deviations, float16, shape (N, 3).
        turn: Quaternions wxyz in steps of 1/32767, int16, shape (N, 4).
        stencil: The number of the stencil of each of them, uint32, shape (L, 1).
        facing: Unit normals of those that move in steps of 1/32767, and 32767 for Gaussians of a solid, int16, shape
            (L, 4).
        color: Red, green, blue and opacity in steps of 1/255, uint8, shape (N, 4).
        growth: Inflation factor while streaming is incomplete (:func:`growth`), in steps of 1/255, uint8, shape (N, 1).
        order: The index of each in the splat, int64, shape (N,); the file does not have it.
        stencils: The nodes of each stencil, as rows of ``displacement``, uint32, shape (S, 27).
        displacement: Displacement of the nodes [m], float32, shape (K, M, 3).
        notes: Sentences on what the film does not show as the run does.
    """

    head: dict[str, Any]
    position: np.ndarray
    arm: np.ndarray
    stencil: np.ndarray
    scale: np.ndarray
    turn: np.ndarray
    facing: np.ndarray
    color: np.ndarray
    growth: np.ndarray
    order: np.ndarray
    stencils: np.ndarray
    displacement: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def place(self) -> np.ndarray:
        """Position at which those that move take displacement and gradient [cells], float32, shape (L, 3)."""
        centre = self.position[: len(self.arm)].astype(np.float64)
        found: np.ndarray = ((centre - self.head["corner"]) / self.head["cell"] - self.arm).astype(np.float32)
        return found

    def moved(self, frame: int) -> tuple[Tensor, Tensor]:
        """Centres and covariances in a frame, as the page draws them, without a limit of stretch.

        Returns:
            Centres, float64, shape (N, 3), and covariances, shape (N, 3, 3).
        """
        head, place = self.head, torch.from_numpy(self.place)
        f = (place - (place - 0.5).floor()).double()  # in float32, as the page does
        w, slope = bspline_weights(f.T)
        rows = torch.from_numpy(self.stencils.astype(np.int64))[torch.from_numpy(self.stencil[:, 0].astype(np.int64))]
        nodes = torch.from_numpy(self.displacement[frame]).double()[rows].unflatten(1, (3, 3, 3)) * head["metre"]
        x, y, z = w.unbind(0)
        along = [(slope[0], y, z), (x, slope[1], z), (x, y, slope[2])]
        u, *columns = (torch.einsum("ap,bp,cp,pabcd->pd", *each, nodes) for each in [(x, y, z), *along])
        grown = torch.stack(columns, -1) / head["cell"]
        centre = torch.from_numpy(self.position).double()
        shape = covariance(torch.from_numpy(self.turn).double() / 32767, torch.from_numpy(self.scale).double())
        arm = centre[: len(place)] - (place.double() * head["cell"] + torch.tensor(head["corner"]))
        centre[: len(place)] += u + (grown @ arm[..., None])[..., 0]
        F = torch.eye(3, dtype=torch.float64) + grown
        shape[: len(place)] = F @ shape[: len(place)] @ F.mT
        return centre, shape


def read_film(run: Path) -> Film:
    """The film of a recorded run of ``total``.

    The Gaussians at rest are made again from the configuration of the run and its splat.

    Args:
        run: The output folder of ``gaussian-swaying sim``.
    """
    played = RecordedRun(run)
    nodes, displacement = played.nodes()
    with torch.inference_mode():
        return film_of(played.simulation, played.start.grid, nodes, displacement, played.name)


def film_without_frames(simulation: Simulation, state: Any, name: str) -> Film:
    """The Gaussians of a simulation at rest, with the nodes that move them."""
    nodes = simulation.scene.follow.nodes(state)
    assert nodes is not None  # the solver is `total` or `modes`
    return film_of(simulation, state.grid, nodes, torch.zeros(0, len(nodes), 3), name)


def film_of(simulation: Simulation, grid: GridSpec, nodes: Tensor, displacement: Tensor, name: str) -> Film:
    """The film of a simulation whose nodes move.

    Args:
        nodes: Flat indices of the nodes in the grid, rising, shape (M,).
        displacement: Their displacements [m], float32, shape (K, M, 3).
    """
    scene, painter = simulation.scene, simulation.painter
    camera = painter.camera_at(0)
    device = scene.model.means.device
    size, count = scene.size * scene.frame.metres_per_unit, len(scene.model.means)
    position = (scene.frame.point_to_sim(in_double(scene.model.means)) / size * GRAIN).round() / GRAIN
    quats = torch.nn.functional.normalize(in_double(scene.model.quats.detach()), dim=-1)
    turn = quat_multiply(rotation_to_quat(in_double(scene.frame.rotation)).to(quats), quats)
    scale = in_double(scene.model.scales.detach()) + math.log(scene.frame.metres_per_unit / size)
    moving, order = order_of(scene)
    place, stencil, stencils = stencils_of(scene.follow.stencil(grid), grid, nodes)
    facing = torch.cat([scene.rest_facing.float(), scene.solid().float()[:, None]], dim=1)[moving]
    color = sh_to_color(scene.model.sh0, torch.ones(count, 3, device=device))
    color = torch.cat([color, scene.model.opacity()[:, None]], dim=-1)
    shader, notes = painter.shader, []
    if not (shader is None or isinstance(shader, DiffuseShader)):
        notes.append(f"the film has no {type(shader).__name__}: the Gaussians keep the colours of the splat.")
    if scene.model.view_dependent:
        notes.append("colours that depend on the direction of view are the same from all sides.")
    head = {
        "count": count,
        "moving": len(moving),
        "nodes": len(nodes),
        "stencils": len(stencils),
        "frames": len(displacement),
        "frame_dt": simulation.frame_dt,
        "step": size / STEPS,
        "error": 0.5 * size / STEPS,
        "cell": grid.dx / size,
        "corner": [first * grid.dx / size for first in grid.offset],
        "max_stretch": scene.max_stretch,
        **look_of(painter),
        **first_view(simulation),
        "title": f"{name[:1].upper()}{name[1:]} in the wind",
    }
    doubled = order.to(position.device)  # where numbers in double precision live
    position = position[doubled].float()
    arm = (in_double(position[: len(moving)]) - position.new_tensor(head["corner"])) / head["cell"] - place[moving]
    arm = (arm * ARM).round() / ARM
    return Film(
        head,
        position.numpy(force=True),
        arm.float().numpy(force=True),
        stencil[moving, None].numpy(force=True).astype(np.uint32),
        scale[doubled].half().numpy(force=True),
        _steps(turn[doubled]),
        _steps(facing, 32768 // NORMAL),
        (color[order].clamp(0, 1) * 255).round().to(torch.uint8).numpy(force=True),
        (growth(scene, camera)[order, None] * 255).round().to(torch.uint8).numpy(force=True),
        order.numpy(force=True),
        stencils.numpy(force=True).astype(np.uint32),
        displacement.numpy(force=True),
        tuple(notes),
    )


def order_of(scene: SimulatedScene) -> tuple[Tensor, Tensor]:
    """The order of the Gaussians in a film: those that move come first. The first of either are spread over all of it.

    Returns:
        The order of ``scene.moving``, as indices in it, shape (L,), and of all, as indices in the splat, shape (N,).
    """
    means, moving = scene.model.means.detach(), scene.moving
    still = torch.ones(len(means), dtype=torch.bool, device=means.device).index_fill(0, moving, False).nonzero()[:, 0]
    first = spread(means[moving], FIRST["moving"])
    return first, torch.cat([moving[first], still[spread(means[still], FIRST["still"])]])


LAYERS = 2.0
"""Optical depth that some of the Gaussians have to keep, so that little shines through: e^-2 is 14 %."""
BLOCK = 16  # pixels


def growth(scene: SimulatedScene, camera: Camera) -> Tensor:
    """Inflation factor of each Gaussian in a partly loaded film, from 0 to 1, shape (N,).

    Of N Gaussians, n cover as much as all if each is s = sqrt(N / n) times as large. Where many lie one behind the
    other, as in haze or in a hedge, less is enough, and the picture is drawn much faster: each becomes max(1, s g)
    times as large, where g is the root of :data:`LAYERS` per optical depth, and at most 1. The optical depth is the sum
    of the integrals of what is centred in a block of pixels, per area of the block.
    """
    means, scales = scene.model.means.detach(), in_double(scene.model.scales.detach())
    seen = means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = seen[:, 2].clamp_min(camera.near)
    fx, fy, (cx, cy) = camera.intrinsics[0, 0], camera.intrinsics[1, 1], camera.intrinsics[:2, 2]
    x, y = ((fx * seen[:, 0] / depth + cx) // BLOCK).long(), ((fy * seen[:, 1] / depth + cy) // BLOCK).long()
    across, along = camera.width // BLOCK + 1, camera.height // BLOCK + 1
    inside = (seen[:, 2] > camera.near) & (x >= 0) & (x < across) & (y >= 0) & (y < along)
    # the geometric mean of the areas along three axes is that of a projection, up to the direction
    area = (2 / 3 * scales.sum(-1)).exp() * float(fx * fy) / in_double(depth) ** 2
    mass = in_double(scene.model.opacity().detach()) * 2 * math.pi * area
    block = torch.where(inside, y * across + x, across * along).to(mass.device)
    total = mass.new_zeros(across * along + 1).index_add(0, block, mass)
    found = (LAYERS * BLOCK**2 / total[block].clamp_min(1e-30)).sqrt().clamp_max(1.0)
    return torch.where(inside.to(found.device), found, 1.0).float().to(means.device)


_EVERY_THIRD_BIT = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that move bit k of a number of 20 bits to bit 3 k."""


def spread(position: Tensor, first: int = 1) -> Tensor:
    """An order (N,) of places (N, 3) whose first ones are spread over all of them.

    Places are sorted along a Z-order curve and taken in the order of van der Corput's sequence: the second lies in the
    middle, the third in the middle of the first half, and so on. Within the part of the ``first``,
    and each of ``PART`` after it, they return to the order of the curve, as neighbours that are alike compress to less.
    """
    count = len(position)
    if count < 2:
        return torch.arange(count, device=position.device)
    low, high = position.amin(0), position.amax(0)
    cells = ((position - low) / (high - low).clamp_min(1e-30) * (2**20 - 1)).long()
    for shift, mask in _EVERY_THIRD_BIT:
        cells = (cells | cells << shift) & mask
    curve = torch.argsort(cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2, stable=True)
    bits = (count - 1).bit_length()
    rank = torch.arange(1 << bits, device=position.device)
    mirrored = torch.zeros_like(rank)
    for bit in range(bits):
        mirrored |= (rank >> bit & 1) << (bits - 1 - bit)
    parts = mirrored[mirrored < count].tensor_split([*range(first, count, PART)])
    return curve[torch.cat([part.sort()[0] for part in parts])]


def look_of(painter: Painter) -> dict[str, Any]:
    """Light and background for the page; the light is None without a :class:`DiffuseShader`."""
    shader, light = painter.shader, None
    if isinstance(shader, DiffuseShader):
        light = {"light": shader.light.tolist(), "two_sided": shader.two_sided, "ambient": shader.ambient}
        light["relative"] = shader.relative
    return {"shader": light, "background": painter.background.tolist()}


def stencils_of(stencil: Stencil, grid: GridSpec, nodes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Places at which the motion is read, and their stencils, for a browser.

    Args:
        nodes: Flat indices of the nodes that are known, rising, shape (M,).

    Returns:
        The places in cells from the first node of the grid, float64, shape (N, 3), nudged so that rounding does not
            move them out of the cell ``floor(place - 0.5)`` of their stencil; the stencil of each, shape (N,); and the
            27 nodes of each stencil, as rows of ``nodes``, shape (S, 27).
    """
    number = torch.unique(stencil.cell, return_inverse=True)[1]
    count = int(number.max()) + 1 if len(number) else 0
    example = number.new_zeros(count).index_copy(0, number, torch.arange(len(number), device=number.device))
    low = in_double(coordinates(stencil.first, grid))
    place = low + in_double(stencil.fraction.T)
    return (
        place.clamp(low + 0.5 + 1 / ARM, low + 1.5 - 1 / ARM),
        number,
        torch.searchsorted(nodes, stencil.node[example]),
    )


def _steps(values: Tensor, grain: int = 1) -> np.ndarray:
    """Numbers from -1 to 1 in steps of 1/32767, in whole grains of some but for the ends."""
    steps = (in_double(values) * 32767 / grain).round() * grain
    found: np.ndarray = steps.clamp(-32767, 32767).to(torch.int16).numpy(force=True)
    return found


def first_view(simulation: Simulation) -> dict[str, Any]:
    """The first camera (eye, target, vertical field of view [degrees], aspect), and a metre in sizes of the object."""
    scene, camera = simulation.scene, simulation.painter.camera_at(0)
    size = scene.size * scene.frame.metres_per_unit
    eye = scene.frame.point_to_sim(in_double(camera.position)) / size
    axis = scene.frame.direction_to_sim(in_double(camera.world_to_camera[2, :3]))
    target = eye + axis * float((-eye * axis).sum().clamp_min(0.2))
    field = 2 * torch.atan(camera.height / (2 * in_double(camera.intrinsics[1, 1])))
    across = camera.width * camera.intrinsics[1, 1] / (camera.height * camera.intrinsics[0, 0])
    looks = {"eye": eye.tolist(), "target": target.tolist(), "fov": float(field.rad2deg()), "aspect": float(across)}
    return {"camera": looks, "metre": 1 / size}
