"""A picture of a splat with the effect of a configuration: simulated part, pins, wind and normals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._files import is_blank
from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.connectivity import shades
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.regions import Box, Region
from gaussian_swaying.preview.apart import pieces_of_nodes
from gaussian_swaying.preview.framing import SOLID, nearby, whole_box
from gaussian_swaying.preview.place import Place
from gaussian_swaying.preview.ticks import draw_ticks
from gaussian_swaying.preview.up import floor_mask, wind_words
from gaussian_swaying.rendering.cameras.camera import Camera, orbit_camera, project
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.thinning import DETAIL
from gaussian_swaying.rendering.tints import HELD, greyed, tinted
from gaussian_swaying.simulation.simulation import Roles, Simulation, classify, conditions

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont, ImageFont

PINNED = HELD
PUSHED = (160, 70, 200)
REGION = (30, 110, 220)
WIND = (0, 140, 110)
NORMAL = (250, 200, 40)
UP = (40, 40, 40)
SOFT = ((60, 70, 220), (0, 170, 60), (170, 60, 170), (220, 150, 0))  # of several soft parts, in turn
PIECES = (*SOFT, (0, 160, 190), (200, 90, 40))  # of what is connected along the surface, in turn
THING = 300  # width and height of the picture of a thing [pixels]
MOST_DRAWN = 200_000  # Gaussians of it
Tint = tuple[str, Tensor, tuple[int, ...]]  # a name, Gaussians and their colour


def box_edges(low: Iterable[float], high: Iterable[float]) -> Tensor:
    """The 12 edges of a box, shape (12, 2, 3)."""
    corners = torch.cartesian_prod(*(torch.tensor(pair, dtype=torch.float64) for pair in zip(low, high, strict=True)))
    edges = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]
    return torch.stack([corners[list(edge)] for edge in edges])


def region_box(region: Region, low: Tensor, high: Tensor) -> tuple[list[float], list[float]] | None:
    """Corners of a box region with its open sides closed at those of the scene; None if it is not a box."""
    if not isinstance(region, Box):
        return None
    first = [max(a, float(b)) for a, b in zip(region.min, low, strict=True)]
    last = [min(a, float(b)) for a, b in zip(region.max, high, strict=True)]
    return None if any(a >= b for a, b in zip(first, last, strict=True)) else (first, last)


@torch.no_grad()
def preview_picture(
    simulation: Simulation,
    height: int = 540,
    normals: int = 140,
    whole: tuple[Sequence[float], Sequence[float]] | None = None,
) -> np.ndarray:
    """The scene at rest from the side of its camera and from 90 degrees to the left, with a legend.

    Args:
        simulation: A run, which need not have started.
        height: Height of each view [pixels].
        normals: About how many normals to draw in each view.
        whole: Corners of the box to show [scene units]; that of the whole object if None.

    Returns:
        8-bit RGB, shape (H, W, 3).
    """
    from PIL import Image, ImageDraw, ImageFont

    parts = classify(simulation)
    frame = simulation.scene.frame
    own = simulation.painter.camera_at(0)
    eye = frame.direction_to_sim(-own.world_to_camera[2, :3].cpu().double())
    azimuth = math.degrees(math.atan2(float(eye[1]), float(eye[0])))
    elevation = math.degrees(math.atan2(float(eye[2]), math.hypot(float(eye[0]), float(eye[1]))))
    elevation = max(-60.0, min(60.0, elevation))
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in whole or _whole(simulation, parts))
    center, reach = (0.5 * (low + high)).tolist(), 1.7 * float((high - low).norm())  # room for arrows and coordinates
    views, (pieces, beside) = [], _pieces(simulation)
    tints = pieces or _soft(simulation)
    for turn in (0.0, 90.0):
        camera = orbit_camera(center, frame.rotation[2], reach, azimuth - turn, elevation, 40.0, height, height)
        title = f"azimuth {azimuth - turn:.0f}°"
        views.append(_view(simulation, parts, camera.to(simulation.device), normals, title, tints))
    entries = _entries(parts, simulation)
    if pieces:
        words = f"one colour: connected along the surface; {100 * beside:.0f} % lie beside something else"
        entries.append((PIECES[0], words))
    else:
        entries += [(tint, f"{name}: {int(mask.sum()):,} Gaussians, soft") for name, mask, tint in tints]
    page = Image.new("RGB", (2 * height, height + 12 + 24 * -(-len(entries) // 2)), (255, 255, 255))
    for k, view in enumerate(views):
        page.paste(view, (k * height, 0))
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(size=14)
    _legend(draw, font, entries, height, 2 * height)
    return np.asarray(page)


@torch.no_grad()
def things_picture(cloud: GaussianCloud, place: Place, chosen: Sequence[int], device: torch.device) -> np.ndarray:
    """The things of a place, each with its number, on what is around it in grey.

    Args:
        cloud: The splat.
        place: Its parts.
        chosen: Numbers of those that will move; they have a frame.
        device: Where to draw.

    Returns:
        8-bit RGB, shape (H, W, 3), up to four in a row.
    """
    from PIL import Image, ImageDraw, ImageFont

    renderer, up = make_renderer(device, detail=DETAIL), torch.tensor(place.up.direction, dtype=torch.float64)
    across = min(4, len(place.things))
    page = Image.new("RGB", (across * THING, -(-len(place.things) // across) * THING), (255, 255, 255))
    font = ImageFont.load_default(size=18)
    for k, thing in enumerate(place.things):
        mine = torch.zeros(len(cloud), dtype=torch.bool)
        mine[thing.members] = True
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (thing.low, thing.high))
        margin = 0.3 * float((high - low).amax())
        shown = ((cloud.means >= (low - margin).float()) & (cloud.means <= (high + margin).float())).all(-1)
        shown &= ~place.far
        index = shown.nonzero()[:, 0]
        index = index[:: max(1, len(index) // MOST_DRAWN)]
        part = cloud.select(index).to(device)
        camera = orbit_camera(
            (0.5 * (low + high)).tolist(), up, 1.5 * float((high - low).norm()), 30.0, 20.0, 40.0, THING, THING
        ).to(device)
        colours = (0.5 + SH_DC * part.sh[:, 0]).clamp(0, 1)
        grey = 0.55 + 0.35 * colours.mean(-1, keepdim=True).expand_as(colours)
        colours = torch.where(mine[index].to(device)[:, None], colours, grey)
        plain = torch.full((3,), 0.96, device=device)
        shape = covariance(part.quats, part.scales)
        image = renderer(part.means, shape, part.opacities.sigmoid(), colours, camera, plain).color
        picture = Image.fromarray((image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
        draw = ImageDraw.Draw(picture)
        if k + 1 in chosen:
            draw.rectangle((1, 1, THING - 2, THING - 2), outline=REGION, width=3)
        draw.text((10, 6), f"{k + 1}" + ("  moves" if k + 1 in chosen else ""), fill=UP, font=font)
        page.paste(picture, (k % across * THING, k // across * THING))
    return np.asarray(page)


def _whole(simulation: Simulation, parts: Roles) -> tuple[list[float], list[float]]:
    """Corners of the box of the whole object, including parts that do not move [scene units]."""
    scene = simulation.scene
    means, opacity = scene.model.means.detach().cpu(), scene.model.opacity().detach().cpu()
    solid = nearby(means, parts.simulated) & (opacity >= SOLID)
    outside = torch.zeros_like(solid)
    weight = (opacity * patch_area(scene.model.to_cloud().scales.detach().cpu())).double()
    outside[solid] = floor_mask(
        means[solid], scene.rest_normals.detach().cpu()[solid], weight[solid], scene.frame.rotation[2].tolist()
    )
    return whole_box(means, opacity, parts.simulated, outside, simulation.solver.dx / scene.frame.metres_per_unit)


def _view(simulation: Simulation, parts: Roles, camera: Camera, normals: int, title: str, tints: Sequence[Tint]) -> Any:
    from PIL import Image, ImageDraw, ImageFont

    scene = simulation.scene
    rest = scene.rest()
    view = torch.nn.functional.normalize(rest.means - camera.position.to(rest.means), dim=-1)
    colours = scene.model.colors(view).clamp(0, 1)
    colours = _tinted(colours, parts, tints)
    plain = torch.full((3,), 0.96, device=colours.device)
    opacity = scene.model.opacity()
    renderer = make_renderer(colours.device, detail=DETAIL)
    image = renderer(rest.means, rest.covariances, opacity, colours, camera, plain).color
    pixels = (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()
    if is_blank(pixels):
        warnings.warn(f"The preview at {title} shows nothing: check that the Gaussians are opaque.", stacklevel=2)
    picture = Image.fromarray(pixels)
    draw = ImageDraw.Draw(picture)
    _draw_normals(draw, scene, parts, camera, normals)
    low, high = (corner.cpu().double() for corner in scene.bounds)
    margin = 0.02 * scene.size
    _draw_edges(draw, box_edges(low - margin, high + margin), camera, REGION)
    font = ImageFont.load_default(size=14)
    draw_ticks(draw, font, (low - margin).tolist(), (high + margin).tolist(), camera)
    for boundary in conditions(simulation):
        region = getattr(boundary, "region", None)
        box = None if region is None else region_box(region, low - margin, high + margin)
        if box is not None:
            _draw_edges(draw, box_edges(*box), camera, PUSHED if boundary.held_share is None else PINNED)
    _draw_wind(draw, simulation, camera)
    up = scene.frame.rotation[2]
    base = scene.center.cpu().double() + 0.0
    _draw_up(draw, font, base, up, camera, scene.size)
    draw.text((8, 6), title, fill=UP, font=font)
    return picture


def _soft(simulation: Simulation) -> list[Tint]:
    parts = simulation.scene.parts
    soft = [] if parts is None else [part.name for part in parts.parts if part.role == "soft"]
    if parts is None or len(soft) < 2:
        return []
    return [(name, parts.mask(name), SOFT[k % len(SOFT)]) for k, name in enumerate(soft)]


def _pieces(simulation: Simulation) -> tuple[list[Tint], float]:
    """Gaussians and colours of what shares nodes, if only what is connected does, and how much lies beside others.

    What a node reaches has one colour if it is connected there, and pieces of it have different ones.
    """
    scene = simulation.scene
    if scene.pairs is None:
        return [], 0.0
    index = scene.simulated.cpu()
    cell, piece, beside = pieces_of_nodes(scene, simulation.solver.dx)
    shade = shades(cell, piece, scene.pairs, len(PIECES))
    found: list[Tint] = []
    for k, colour in enumerate(PIECES):
        mask = torch.zeros(len(scene.model.means), dtype=torch.bool)
        mask[index[shade == k]] = True
        found.append(("", mask, colour))
    return found, beside


def _tinted(colours: Tensor, parts: Roles, soft: Sequence[Tint] = ()) -> Tensor:
    for _, mask, tint in soft:
        colours = torch.where(mask.to(colours.device)[:, None], tinted(colours, tint, 0.4), colours)
    still = (~(parts.simulated | parts.carried)).to(colours.device)
    colours = torch.where(still[:, None], greyed(colours), colours)
    for mask, tint in ((parts.pushed, PUSHED), (parts.pinned, PINNED)):
        colours = torch.where(mask.to(colours.device)[:, None], tinted(colours, tint), colours)
    return colours


def _draw_edges(draw: ImageDraw, edges: Tensor, camera: Camera, colour: tuple[int, ...]) -> None:
    ends, depth = project(edges.reshape(-1, 3), camera)
    for (a, b), deep in zip(ends.reshape(-1, 2, 2).tolist(), depth.reshape(-1, 2).tolist(), strict=True):
        if min(deep) > camera.near:
            draw.line([tuple(a), tuple(b)], fill=colour, width=2)


def _draw_arrow(
    draw: ImageDraw, tail: Tensor, tip: Tensor, camera: Camera, colour: tuple[int, ...], width: int
) -> None:
    """An arrow between two points in the scene, its head in the plane of the picture."""
    (a, b), depth = project(torch.stack([tail, tip]), camera)
    if float(depth.min()) <= camera.near:
        return
    draw.line([tuple(a.tolist()), tuple(b.tolist())], fill=colour, width=width)
    way = b - a
    length = float(way.norm())
    if length < 2:  # towards or away from the eye
        x, y = b.tolist()
        draw.ellipse([x - 3, y - 3, x + 3, y + 3], outline=colour, width=2)
        return
    along = way / length
    across = torch.stack([-along[1], along[0]])
    size = min(3.5 * width + 3, 0.6 * length)
    corners = [b, b - size * along + 0.45 * size * across, b - size * along - 0.45 * size * across]
    draw.polygon([tuple(c.tolist()) for c in corners], fill=colour)


def _draw_normals(draw: ImageDraw, scene: Any, parts: Roles, camera: Camera, count: int) -> None:
    index = parts.simulated.nonzero()[:, 0]
    # the largest visible patch of each cell of a coarse lattice over the picture, so that they are spread
    means = scene.model.means.detach().cpu()[index].double()
    pixel, depth = project(means, camera)
    cells = max(4, round(2.2 * math.sqrt(count)))
    step = max(camera.width, camera.height) / cells
    inside = (depth > camera.near) & (pixel >= 0).all(-1) & (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
    key = (pixel / step).floor().long()
    key = key[:, 0] * (cells + 1) + key[:, 1]
    opaque = scene.model.opacity().detach().cpu()[index] >= 0.5
    if bool((opaque & inside).any()):
        inside = inside & opaque
    order = depth.argsort()
    order = order[inside[order]]
    seen: set[int] = set()
    chosen = [i for i in order.tolist() if not (int(key[i]) in seen or seen.add(int(key[i])))]  # type: ignore[func-returns-value]
    if not chosen:
        return
    pick = torch.tensor(chosen)
    normal = scene.rest_normals.detach().cpu()[index[pick]].double()
    eye = camera.position.cpu().double()
    toward = ((eye - means[pick]) * normal).sum(-1, keepdim=True)
    normal = torch.where(toward < 0, -normal, normal)
    start, _ = project(means[pick], camera)
    end, _ = project(means[pick] + 0.035 * scene.size * normal, camera)
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        draw.line([tuple(a), tuple(b)], fill=(60, 50, 0), width=3)
        draw.line([tuple(a), tuple(b)], fill=NORMAL, width=1)


def _draw_wind(draw: ImageDraw, simulation: Simulation, camera: Camera) -> None:
    scene, frame = simulation.scene, simulation.scene.frame
    flow = mean_flow(simulation)
    speed = float(flow.norm())
    if speed == 0:
        return
    direction = flow / speed
    low, high = (frame.point_to_sim(corner.cpu().double()) for corner in scene.bounds)
    low, high = torch.minimum(low, high), torch.maximum(low, high)
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    size = float(2 * half.amax())
    upwind = float((half * direction.abs()).sum()) + 0.06 * size
    helper = torch.tensor([0.0, 0.0, 1.0] if abs(float(direction[2])) < 0.9 else [1.0, 0.0, 0.0], dtype=torch.float64)
    first = torch.linalg.cross(direction, helper)
    first = first / first.norm()
    second = torch.linalg.cross(first, direction)
    wide, tall = float((half * first.abs()).sum()), float((half * second.abs()).sum())
    for a in (-0.7, 0.7):
        for b in (-0.8, -0.27, 0.27, 0.8):
            tip = centre - upwind * direction + a * wide * first + b * tall * second
            tail = tip - 0.2 * size * direction
            ends = frame.point_to_scene(torch.stack([tail, tip]))
            _draw_arrow(draw, ends[0], ends[1], camera, WIND, 2)


def mean_flow(simulation: Simulation) -> Tensor:
    """Flow without modulations [m/s], z up, shape (3,), float64; for a schedule its strongest entry."""
    flows = simulation.stepper.flows().detach().cpu().double().reshape(-1, 3)
    return flows[int(flows.norm(dim=-1).argmax())]


def _draw_up(draw: ImageDraw, font: Any, base: Tensor, up: Tensor, camera: Camera, size: float) -> None:
    """An arrow that points up, in the lower left corner, as long as a tenth of the picture."""
    (a, b), _ = project(torch.stack([base, base + 0.1 * size * up.double()]), camera)
    way = b - a
    length = float(way.norm())
    if length < 1e-6:
        return
    way = way / length * 0.09 * camera.height
    tail = torch.tensor([26.0, camera.height - 18.0], dtype=torch.float64)
    tip = tail + way
    draw.line([tuple(tail.tolist()), tuple(tip.tolist())], fill=UP, width=3)
    along = way / way.norm()
    across = torch.stack([-along[1], along[0]])
    draw.polygon([tuple(c.tolist()) for c in (tip + 8 * along, tip + 5 * across, tip - 5 * across)], fill=UP)
    draw.text((36, camera.height - 36), "up", fill=UP, font=font)


def _entries(parts: Roles, simulation: Simulation) -> list[tuple[tuple[int, ...], str]]:
    flow = mean_flow(simulation).tolist()
    entries: list[tuple[tuple[int, ...], str]] = [
        (REGION, f"box of the {int(parts.simulated.sum()):,} simulated Gaussians [scene units]"),
        (PINNED, f"held: {int(parts.pinned.sum()):,} Gaussians"),
        (WIND, f"steady wind {wind_words(flow, simulation.scene.frame.rotation[2].tolist())}"),
        (NORMAL, "normals, flipped to the eye"),
        ((190, 190, 190), f"not simulated: {int((~(parts.simulated | parts.carried)).sum()):,} Gaussians, greyed"),
        ((120, 120, 120), f"faint or loose, follow their neighbours: {int(parts.carried.sum()):,} Gaussians"),
    ]
    if bool(parts.pushed.any()):
        entries.append((PUSHED, f"pushed: {int(parts.pushed.sum()):,} Gaussians"))
    return entries


def _legend(
    draw: ImageDraw,
    font: FreeTypeFont | ImageFont,
    entries: Sequence[tuple[tuple[int, ...], str]],
    top: int,
    width: int,
) -> None:
    for k, (colour, text) in enumerate(entries):
        x, y = 14 + (k % 2) * (width // 2), top + 12 + 24 * (k // 2)
        draw.rectangle([x, y + 2, x + 16, y + 14], fill=colour)
        draw.text((x + 26, y), text, fill=UP, font=font)
