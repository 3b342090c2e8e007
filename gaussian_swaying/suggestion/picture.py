"""Pictures of a splat with the effect of a configuration: simulated part, pins, wind and normals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._files import is_blank
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.measures import Array, Gaussians, corners, pieces, plane_axes
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.rendering.cameras.camera import Camera, orbit_camera, project
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.thinning import DETAIL
from gaussian_swaying.rendering.tints import HELD, greyed, tinted
from gaussian_swaying.simulation.simulation import Roles, Simulation, classify, conditions
from gaussian_swaying.suggestion.moves import Place, nearby
from gaussian_swaying.suggestion.up import floor_mask, wind_words

Colour = tuple[int, ...]
PUSHED, REGION, WIND = (160, 70, 200), (30, 110, 220), (0, 140, 110)
NORMAL, INK = (200, 150, 0), (40, 40, 40)
SOFT = ((60, 70, 220), (0, 170, 60), (170, 60, 170), (220, 150, 0))  # of several soft parts, in turn
THING, MOST_DRAWN = 300, 200_000  # width and height of the picture of a thing [pixels]; Gaussians of it
RADIUS = 1.9  # distance of a camera in multiples of the longest side of the shown box
LATTICE = 18  # cells along the picture, each of which shows a normal
SOLID = 0.1  # opacity of what is shown
ARROW, TIPS = 0.2, [(a, b) for a in (-0.7, 0.7) for b in (-0.8, -0.27, 0.27, 0.8)]
"""Length of an arrow of the wind over the size of what moves, and where they end, over the half sizes across."""


# ---- what a camera should show


def whole_box(splat: Gaussians, simulated: Array, outside: Array, cell: float) -> tuple[list[float], list[float]]:
    """Box of the moving part and everything connected with it, at most one longest side larger on each side.

    Args:
        simulated: The moving part, bool, shape (N,).
        outside: Gaussians that are not part of the object, such as a floor, bool, shape (N,).
        cell: Points in the same or in touching cells of this size are connected [scene units].

    Returns:
        Lower and upper corner [scene units].
    """
    means = splat.means
    low, high = means[simulated].min(0), means[simulated].max(0)
    index = np.flatnonzero(simulated | (nearby(means, simulated) & ~outside & (splat.opacity >= SOLID)))
    part, own = pieces(means[index], cell), simulated[index]
    count = np.bincount(part, own)
    joined = means[index[(count >= max(0.01 * own.sum(), 1))[part]]]
    if len(joined) > own.sum():  # specks do not count
        first, last = corners(joined, 0.002)
        low, high = np.minimum(low, first), np.maximum(high, last)
    return low.tolist(), high.tolist()


def orbit_frame(whole: Sequence[Sequence[float]], moving: Sequence[Sequence[float]]) -> tuple[list[float], float]:
    """Target and distance of an orbit camera that shows the whole object.

    Args:
        whole: Corners of the box of the whole object [scene units].
        moving: Corners of the box of the moving part [scene units].

    Returns:
        ``target_offset`` and ``radius`` of an orbiting camera, in multiples of the longest side of the moving part.
    """
    size, all_of_it = (float(np.ptp(box, axis=0).max()) for box in (moving, whole))
    shift = (np.mean(whole, 0) - np.mean(moving, 0)) / size
    if all_of_it < 1.02 * size and np.abs(shift).max() < 0.02:
        return [0.0, 0.0, 0.0], RADIUS
    return [round(float(c), 3) + 0.0 for c in shift], round(RADIUS * all_of_it / size, 2)


def mean_flow(simulation: Simulation) -> Tensor:
    """Flow without modulations [m/s], z up, shape (3,), float64; for a schedule its strongest entry."""
    flows = simulation.stepper.flows().detach().cpu().double().reshape(-1, 3)
    return flows[int(flows.norm(dim=-1).argmax())]


def _whole(simulation: Simulation, roles: Roles) -> tuple[list[float], list[float]]:
    """Corners of the box of the whole object, including parts that do not move [scene units]."""
    scene, simulated = simulation.scene, roles.simulated.numpy()
    splat = Gaussians.of(scene.model.to_cloud().to("cpu"))
    solid = nearby(splat.means, simulated) & (splat.opacity >= SOLID)
    outside = np.zeros_like(solid)
    outside[solid] = floor_mask(splat[solid], scene.frame.rotation[2].numpy())
    return whole_box(splat, simulated, outside, simulation.solver.dx / scene.frame.metres_per_unit)


# ---- drawing


class View:
    """A picture of Gaussians and its camera, to draw on in scene units."""

    def __init__(self, colours: Tensor, splat: tuple[Tensor, Tensor, Tensor], camera: Camera) -> None:
        from PIL import Image, ImageDraw, ImageFont

        renderer = make_renderer(colours.device, detail=DETAIL)
        means, covariances, opacity = splat
        plain = torch.full((3,), 0.96, device=colours.device)
        image = renderer(means, covariances, opacity, colours, camera.to(colours.device), plain).color
        self.pixels = (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
        self.camera, self.picture = camera, Image.fromarray(self.pixels)
        self.draw, self.font = ImageDraw.Draw(self.picture), ImageFont.load_default(size=14)

    def text(self, place: Any, words: str, anchor: str = "la") -> None:
        """Write words in a place [pixels]."""
        self.draw.text(place, words, INK, self.font, anchor, stroke_width=2, stroke_fill=(255, 255, 255))

    def lines(self, ends: Array, colour: Colour, width: int = 2, head: float = 0.0) -> None:
        """Lines between pairs of places in front of the camera [scene units], shape (K, 2, 3), or arrows."""
        for a, b in self.seen(ends):
            self.stroke(a, b, colour, width, head)

    def stroke(self, a: Array, b: Array, colour: Colour, width: int, head: float) -> None:
        """A line between two pixels, or an arrow with a head of some pixels."""
        self.draw.line([*a, *b], colour, width)
        if head:
            back = head * (a - b) / max(np.linalg.norm(a - b), 1e-6)
            across = 0.45 * back[::-1] * [1, -1]
            self.draw.polygon([*b, *(b + back + across), *(b + back - across)], colour)

    def seen(self, ends: Array) -> Array:
        """Pixels of pairs of places that are in front of the camera, shape (K, 2, 2)."""
        pixel, depth = project(torch.from_numpy(ends.reshape(-1, 3)), self.camera)
        return pixel.reshape(-1, 2, 2).numpy()[depth.reshape(-1, 2).numpy().min(1) > self.camera.near]

    def box(self, low: Array, high: Array, colour: Colour, named: bool = False) -> None:
        """The edges of a box, and the coordinates at the ends of the lowest one along each axis."""
        corner = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
        taken: list[Array] = []
        for axis, name in enumerate("xyz"):
            first = [k for k in range(8) if not k & 4 >> axis]
            edges = np.stack([corner[first], corner[[k + (4 >> axis) for k in first]]], 1)
            self.lines(edges, colour)
            lowest = max(self.seen(edges), key=lambda edge: edge[:, 1].mean(), default=()) if named else ()
            for place, value in zip(lowest, (low[axis], high[axis]), strict=False):
                line = sum(np.linalg.norm(place - other) < 20 for other in taken)
                x, y = min(max(place[0], 30), self.camera.width - 30), place[1] + 4 + 14 * line
                self.text((x, min(y, self.camera.height - 14)), f"{name} {value + 0.0:.3g}", "ma")
                taken.append(place)


@torch.no_grad()
def preview_picture(
    simulation: Simulation, height: int = 540, whole: tuple[Sequence[float], Sequence[float]] | None = None
) -> Array:
    """The scene at rest from the side of its camera and from 90 degrees to the left, with a legend.

    Args:
        height: Height of each view [pixels].
        whole: Corners of the box to show [scene units]; that of the whole object if None.

    Returns:
        8-bit RGB, shape (H, W, 3).
    """
    from PIL import Image, ImageDraw

    scene, roles = simulation.scene, classify(simulation)
    frame, parts = scene.frame, scene.parts
    soft = [part.name for part in parts.parts if part.role == "soft"] if parts is not None else []
    tints = [(n, parts.mask(n), SOFT[k % len(SOFT)]) for k, n in enumerate(soft) if parts and len(soft) > 1]
    x, y, z = frame.direction_to_sim(-simulation.painter.camera_at(0).world_to_camera[2, :3].cpu().double()).tolist()
    azimuth, elevation = math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))
    ends = np.array(whole or _whole(simulation, roles))
    reach = 1.8 * float(np.linalg.norm(np.ptp(ends, axis=0)))  # room for arrows and coordinates
    wind = wind_words(mean_flow(simulation).tolist(), frame.rotation[2].tolist())

    def gaussians(mask: Tensor) -> str:
        return f"{int(mask.sum()):,} Gaussians"

    entries = [
        (REGION, f"box of the {int(roles.simulated.sum()):,} simulated Gaussians [scene units]"),
        (HELD, f"held: {gaussians(roles.pinned)}"),
        (WIND, f"steady wind {wind}"),
        (NORMAL, "normals, flipped to the eye"),
        ((190, 190, 190), f"not simulated: {gaussians(~(roles.simulated | roles.carried))}, greyed"),
        ((120, 120, 120), f"faint or loose, follow their neighbours: {gaussians(roles.carried)}"),
        *([(PUSHED, f"pushed: {gaussians(roles.pushed)}")] if bool(roles.pushed.any()) else []),
        *((tint, f"{name}: {gaussians(mask)}, soft") for name, mask, tint in tints),
    ]
    page = Image.new("RGB", (2 * height, height + 12 + 24 * -(-len(entries) // 2)), (255, 255, 255))
    for k, turned in enumerate((azimuth, azimuth - 90)):
        given = frame.rotation[2], reach, turned, min(max(elevation, -60.0), 60.0), 40.0, height, height
        view = _view(simulation, roles, orbit_camera(ends.mean(0).tolist(), *given), tints)
        view.text((8, 6), f"azimuth {turned:.0f}°")
        page.paste(view.picture, (k * height, 0))
    draw = ImageDraw.Draw(page)
    for k, (colour, text) in enumerate(entries):
        left, top = 14 + k % 2 * height, height + 12 + 24 * (k // 2)
        draw.rectangle([left, top + 2, left + 16, top + 14], colour)
        draw.text((left + 26, top), text, INK, view.font)
    return np.asarray(page)


def _view(simulation: Simulation, roles: Roles, camera: Camera, tints: Sequence[tuple[str, Tensor, Colour]]) -> View:
    scene, rest = simulation.scene, simulation.scene.rest()
    toward = torch.nn.functional.normalize(camera.position.to(rest.means) - rest.means, dim=-1)
    colours, opacity = scene.model.colors(-toward).clamp(0, 1), scene.model.opacity()
    view = View(roles_tinted(colours, roles, tints), (rest.means, rest.covariances, opacity), camera)
    if is_blank(view.pixels):
        warnings.warn("The preview shows nothing: check that the Gaussians are opaque.", stacklevel=2)
    # a normal for each cell of a lattice over the picture: that of the nearest solid Gaussian
    means, normals = (of.cpu().double().numpy() for of in (rest.means, scene.rest_normals))
    pixel, depth = (of.numpy() for of in project(torch.from_numpy(means), camera))
    cell = np.floor(pixel * LATTICE / camera.height).astype(int)
    inside = roles.simulated.numpy() & (depth > camera.near) & (cell >= 0).all(1) & (cell < LATTICE).all(1)
    opaque = inside & (opacity.cpu().numpy() >= 0.5)
    index = np.flatnonzero(opaque if opaque.any() else inside)
    index = index[depth[index].argsort()]
    index = index[np.unique(cell[index] @ [LATTICE, 1], return_index=True)[1]]
    sides = normals * np.where((toward.cpu().numpy() * normals).sum(1, keepdims=True) < 0, -1, 1)
    for colour, width in ((INK, 3), (NORMAL, 1)):
        view.lines(np.stack([means, means + 0.035 * scene.size * sides], 1)[index], colour, width)
    low, high = (bound.cpu().double().numpy() for bound in scene.bounds)
    middle, margin = 0.5 * (low + high), 0.02 * scene.size
    view.box(low - margin, high + margin, REGION, named=True)
    for boundary in conditions(simulation):
        region = getattr(boundary, "region", None)
        if isinstance(region, Box):
            first, last = np.maximum(region.min, low - margin), np.minimum(region.max, high + margin)
            if (first < last).all():
                view.box(first, last, PUSHED if boundary.pinned_share is None else HELD)
    flow = mean_flow(simulation)
    if bool(flow.any()):
        along = scene.frame.direction_to_scene(flow / flow.norm()).numpy()
        across, half = plane_axes(along).T, 0.5 * (high - low)
        start = middle - (half @ np.abs(along) + 0.06 * scene.size) * along
        tips = start + np.array(TIPS) @ (across * (np.abs(across) @ half)[:, None])
        view.lines(np.stack([tips - ARROW * scene.size * along, tips], 1), WIND, head=10.0)
    a, b = view.seen(np.stack([middle, middle + 0.1 * scene.size * scene.frame.rotation[2].numpy()])[None])[0]
    base = np.array([26.0, camera.height - 18.0])
    view.stroke(base, base + 0.1 * camera.height * (b - a) / max(np.linalg.norm(b - a), 1e-6), INK, 3, 12.0)
    view.text((36, camera.height - 36), "up")
    return view


def roles_tinted(colours: Tensor, roles: Roles, tints: Sequence[tuple[str, Tensor, Colour]] = ()) -> Tensor:
    """Colours (N, 3) tinted by part, and by pushed or pinned; grey where nothing moves."""
    shown = [(mask, tinted(colours, tint, 0.4)) for _, mask, tint in tints]
    for mask, other in [*shown, (~(roles.simulated | roles.carried), greyed(colours))]:
        colours = torch.where(mask.to(colours.device)[:, None], other, colours)
    for mask, tint in ((roles.pushed, PUSHED), (roles.pinned, HELD)):
        colours = torch.where(mask.to(colours.device)[:, None], tinted(colours, tint), colours)
    return colours


@torch.no_grad()
def things_picture(cloud: GaussianCloud, place: Place, chosen: Sequence[int], device: torch.device) -> Array:
    """Numbered pictures of the things of a place, with their surroundings in grey.

    Returns:
        8-bit RGB, shape (H, W, 3), up to four in a row.
    """
    across, up, means, found = min(4, len(place.things)), torch.tensor(place.up.direction), cloud.means.numpy(), []
    for number, thing in enumerate(place.things, start=1):
        size = np.subtract(thing.high, thing.low)
        low, high = thing.low - 0.3 * size.max(), thing.high + 0.3 * size.max()
        index = np.flatnonzero(((means >= low) & (means <= high)).all(1) & ~place.far)
        index = index[:: max(1, len(index) // MOST_DRAWN)]
        part = cloud.select(torch.from_numpy(index))
        colours = Gaussians.of(part).colour
        grey = 0.55 + 0.35 * colours.mean(1, keepdims=True)
        shown = torch.from_numpy(np.where(np.isin(index, thing.members)[:, None], colours, grey)).to(device)
        centre, reach, part = (0.5 * (low + high)).tolist(), 1.5 * float(np.linalg.norm(size)), part.to(device)
        camera = orbit_camera(centre, up, reach, 30.0, 20.0, 40.0, THING, THING)
        view = View(shown, (part.means, covariance(part.quats, part.scales), part.opacities.sigmoid()), camera)
        if number in chosen:
            view.draw.rectangle((1, 1, THING - 2, THING - 2), outline=REGION, width=3)
        view.text((10, 6), f"{number}  moves" if number in chosen else f"{number}")
        found.append(np.asarray(view.picture))
    found += [np.full_like(found[0], 255)] * (-len(found) % across)
    return np.concatenate([np.concatenate(found[k : k + across], 1) for k in range(0, len(found), across)])
