"""Points inside solids: a density grid of the Gaussians, the cells that it encloses, and the volume of each point.

Everything is computed on the CPU in a fixed order, so the points are the same on every device.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from gaussian_swaying._checks import check_positive
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.geometry.neighbours import nearest_neighbours

MAX_CELLS = 30_000_000  # of the density grid: 120 MB, and about ten times that while it is in use
_BLUR = 0.5  # standard deviation of the blur that keeps thin Gaussians from falling between cell centres, in cells
_CUT = 3.0  # where a kernel ends, in standard deviations
_CHUNK = 1_000_000  # values in memory at a time


def density_grid(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    low: Tensor,
    spacing: float,
    resolution: tuple[int, int, int],
    max_radius: int = 8,
    chunk: int = _CHUNK,
    advance: Callable[[int], object] = lambda count: None,
) -> Tensor:
    r"""Density of Gaussians at the centres of the cells of a grid.

    .. math::
        d(x) = \sum_i o_i \frac{s_1 s_2}{s'_1 s'_2}
        \exp\bigl(-\tfrac12 (x - x_i)^T (A_i + \tfrac14 h^2 I)^{-1} (x - x_i)\bigr), \qquad
        s'^2 = s^2 + \tfrac14 h^2

    Because of the blur by half a cell h, no Gaussian, however thin, is missed between the centres. The factor with the
    two larger standard deviations s keeps the density of a sheet unchanged. A kernel ends three standard deviations
    from its centre along each axis, and at most ``max_radius`` cells from it, so that a huge Gaussian costs no more
    than a large one.

    Args:
        means: Centres [m], shape (N, 3).
        covariances: Covariances A [m²], shape (N, 3, 3).
        opacities: Opacities o from 0 to 1, shape (N,).
        low: Lower corner of the grid [m], shape (3,).
        spacing: Side of a cell h [m].
        max_radius: Longest reach of a kernel [cells].

    Returns:
        Density in float32, shape (nx, ny, nz).
    """
    size = torch.tensor(resolution)
    place = (means.double() - low) / spacing - 0.5  # in cells, from the centre of the first
    wide = covariances.double() / spacing**2 + _BLUR**2 * torch.eye(3, dtype=torch.float64)
    reach = (_CUT * wide.diagonal(dim1=-2, dim2=-1).sqrt()).ceil().clamp(max=max_radius).long()
    home = place.round().long()
    touches = ((home + reach >= 0) & (home - reach < size)).all(-1)
    margin = 2 * int(reach.max()) if len(means) else 0  # large enough for all kernels that touch the grid
    padded = size + 2 * margin + 1
    stride = torch.stack([padded[1] * padded[2], padded[2], torch.ones_like(padded[0])])
    base = ((home + margin) * stride).sum(-1)
    fraction = (place - home).float()
    larger = torch.linalg.eigvalsh(covariances.double())[:, 1:].clamp_min(0) / spacing**2
    weight = (opacities.double() * (larger / (larger + _BLUR**2)).prod(-1).sqrt()).float()
    inverse = torch.linalg.inv(wide).float()
    grid = torch.zeros(int(padded.prod()))
    advance(int((~touches).sum()))
    kept = touches.nonzero()[:, 0]
    kind = equal_rows(reach[kept])
    for members in (kept[kind == k] for k in kind.unique()):
        cells = torch.cartesian_prod(*(torch.arange(-r, r + 1) for r in reach[members[0]].tolist())).reshape(-1, 3)
        shift = (cells * stride).sum(-1)
        ox, oy, oz = cells.float().unbind(-1)
        for rows in members.split(max(1, chunk // len(cells))):
            fx, fy, fz = fraction[rows, :, None].unbind(1)
            m = inverse[rows]
            x, y, z = ox - fx, oy - fy, oz - fz
            power = x * (m[:, 0, 0, None] * x + 2 * (m[:, 0, 1, None] * y + m[:, 0, 2, None] * z))
            power += y * (m[:, 1, 1, None] * y + 2 * m[:, 1, 2, None] * z)
            power += m[:, 2, 2, None] * z * z
            value = weight[rows, None] * power.mul_(-0.5).exp_()
            grid.index_add_(0, (base[rows, None] + shift).reshape(-1), value.reshape(-1))
            advance(len(rows))
    inner = slice(margin, -margin - 1)
    return grid.reshape(padded.tolist())[inner, inner, inner].contiguous()


def ray_directions(count: int) -> list[tuple[int, int, int]]:
    """The 6, 18 or 26 directions from a cell to its neighbours across faces, edges and corners."""
    if count not in (6, 18, 26):
        raise ValueError(f"Expected `directions` to be 6, 18 or 26, but got {count}.")
    every = sorted(itertools.product((-1, 0, 1), repeat=3), key=lambda d: sum(map(abs, d)))
    return [(x, y, z) for x, y, z in every[1 : count + 1]]


def odd_crossings(dense: Tensor, direction: tuple[int, int, int]) -> Tensor:
    """Cells whose ray enters dense matter an odd number of times before it leaves the grid.

    Args:
        dense: Cells whose density is above the threshold, bool, shape (nx, ny, nz).
        direction: Steps of the ray along the axes, each -1, 0 or 1, not all 0.

    Returns:
        Booleans, shape (nx, ny, nz). The surface of a closed body is crossed an odd number of times from inside.
    """
    main = max(range(3), key=lambda axis: abs(direction[axis]))
    order = [main, *(axis for axis in range(3) if axis != main)]
    step, b, c = (direction[axis] for axis in order)
    solid = torch.nn.functional.pad(dense.permute(order), (1,) * 6)
    odd = torch.zeros_like(solid)
    nx, ny, nz = (n - 2 for n in solid.shape)
    there = (slice(1 + b, ny + 1 + b), slice(1 + c, nz + 1 + c))
    here = (slice(1, -1), slice(1, -1))
    for i in range(nx, 0, -1) if step > 0 else range(1, nx + 1):
        enters = solid[i + step][there] & ~solid[i][here]
        odd[i][here] = odd[i + step][there] ^ enters
    return odd[1:-1, 1:-1, 1:-1].permute(sorted(range(3), key=order.__getitem__)).contiguous()


def enclosed(
    dense: Tensor, directions: int = 26, votes: float = 0.75, advance: Callable[[int], object] = lambda count: None
) -> Tensor:
    """Cells inside a body: not dense, and most rays from them cross its surface an odd number of times.

    The majority outvotes a ray that grazes a wall or passes through a gap. In a bowl the rays upwards vote against.

    Args:
        dense: Cells whose density is above the threshold, bool, shape (nx, ny, nz).
        directions: Number of rays from each cell: 6, 18 or 26.
        votes: Share of the rays that must cross the surface an odd number of times, above 0.5 and at most 1.
        advance: Called with 1 after each direction.

    Returns:
        Booleans, shape (nx, ny, nz).
    """
    odd = torch.zeros(dense.shape, dtype=torch.uint8)
    for direction in ray_directions(directions):
        odd += odd_crossings(dense, direction)
        advance(1)
    return (odd >= votes * directions - 1e-9) & ~dense


def open_air(air: Tensor) -> Tensor:
    """Air cells connected to the outside through faces.

    Args:
        air: Cells that are air, bool, shape (nx, ny, nz); everything outside the grid is air.

    Returns:
        Booleans, shape (nx, ny, nz): air without closed cavities.
    """
    from scipy.ndimage import label

    number = torch.from_numpy(label(torch.nn.functional.pad(air, (1,) * 6, value=True).numpy())[0])
    return (number == number[0, 0, 0])[1:-1, 1:-1, 1:-1]


def depth_below(mask: Tensor, width: float) -> Tensor:
    """Depth of each cell below the surface of a mask [cells], from the mask blurred by a Gaussian.

    Behind a plane the blurred mask is the normal distribution Phi(depth / width); its inverse gives the depth to a
    fraction of a cell, for any direction of the plane. It is correct within about three widths of the surface.

    Args:
        mask: Booleans, shape (nx, ny, nz); outside the grid it is false.
        width: Standard deviation of the blur [cells].

    Returns:
        Depth in float32, negative outside, shape (nx, ny, nz).
    """
    radius = math.ceil(_CUT * width)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=torch.float64) / width) ** 2)
    field = mask.float()
    for axis in range(3):
        count = field.shape[axis]
        total = torch.zeros_like(field)
        for offset, tap in enumerate((taps / taps.sum()).tolist(), start=-radius):
            length = count - abs(offset)
            if length > 0:
                part = field.narrow(axis, max(offset, 0), length)
                total.narrow(axis, max(-offset, 0), length).add_(part, alpha=tap)
        field = total
    return width * torch.special.ndtri(field.clamp_(1e-5, 1 - 1e-5))


def sample(field: Tensor, cells: Tensor, chunk: int = _CHUNK) -> Tensor:
    """Trilinear interpolation of a grid (nx, ny, nz) at points (M, 3) in cells from the centre of the first; (M,)."""
    last = torch.tensor(field.shape, dtype=torch.float64) - 1
    parts = [
        torch.nn.functional.grid_sample(
            field[None, None], (part / last * 2 - 1).float().flip(-1)[None, :, None, None], align_corners=True
        ).reshape(-1)
        for part in cells.split(chunk)
    ]
    return torch.cat(parts) if parts else field.new_zeros(0)


def sheet_depth(density: Tensor, cells: Tensor, covariances: Tensor, threshold: float) -> float:
    """Return the distance by which dense cells extend beyond the centre of the median Gaussian [cells].

    A sheet with density d at its centres and a standard deviation s across it falls to the threshold at
    s sqrt(2 log(d / threshold)).

    Args:
        cells: Centres of the Gaussians in cells from the centre of the first, shape (N, 3).
        covariances: Covariances [cells²], shape (N, 3, 3).

    Returns:
        Between 0.5 and 4.
    """
    across = (torch.linalg.eigvalsh(covariances.double())[:, 0].clamp_min(0) + _BLUR**2).sqrt()
    ratio = (sample(density, cells).double() / threshold).clamp_min(1.0)
    depth = across * (2 * ratio.log()).sqrt()
    seen = depth[ratio > 1]
    return float(seen.median().clamp(0.5, 4.0)) if len(seen) else 0.5


@dataclass(frozen=True, slots=True)
class Filling:
    """The result of filling a body.

    Attributes:
        position: Points inside it [m], shape (Q, 3), float64.
        volume: Volume of each [m³], shape (Q,).
        gaussian_volume: Volume of each Gaussian on or in the solid [m³], shape (N,); zero for those more than a cell
            away from it. Together with ``volume`` it adds up to the volume of the solid.
        on_surface: Which Gaussians touch air that is connected to the outside, bool, shape (N,).
    """

    position: Tensor
    volume: Tensor
    gaussian_volume: Tensor
    on_surface: Tensor


def share_volume(owner: Tensor, filled: Tensor, element: float) -> tuple[Tensor, Tensor]:
    """Share the volume of each element equally among the points in it.

    Args:
        owner: Element of each Gaussian, -1 for none, shape (N,).
        filled: Whether an element also has a filled point, shape (K,).
        element: Volume of an element [m³].

    Returns:
        Volume of the filled points [m³], shape (Q,), and of the Gaussians, shape (N,), zero without an element.
    """
    count = filled.double().index_add_(0, owner[owner >= 0], torch.ones(int((owner >= 0).sum()), dtype=torch.float64))
    each = element / count
    return each[filled], torch.where(owner >= 0, each[owner.clamp_min(0)] if len(each) else 0.0, 0.0)


@fixed
@dataclass
class InteriorFilling:
    """Fills the inside of solids with points that carry mass, feel no wind and are not drawn.

    A grid of the Gaussians' density (:func:`density_grid`) separates matter from air. Air cells from which most rays
    cross the surface an odd number of times (:func:`enclosed`) are filled. The dense cells of the surface itself are a
    layer about two cells thick. Its outer half is removed again (:func:`sheet_depth`), so that the body ends at the
    centres of its outer Gaussians, and a single sheet encloses nothing. The volume of each element of the solid is
    shared equally among the points in it, Gaussians and filled points alike, so the body weighs density x volume and
    needs no thickness.

    A Gaussian is on the surface if it is less than a cell below air that is connected to the outside. The leaves inside
    a crown are on the surface. The wall of a closed cavity and the inside of a solid are not.

    Args:
        spacing: Side of a cell [m]; half of ``solver.dx`` if null. Holes in the surface must be smaller.
        threshold: Density above which a cell contains matter; a surface covered once has about 1.
        directions: Rays per cell: 6, 18 or 26.
        votes: Share of the rays that must cross the surface an odd number of times, above 0.5. At the bottom of a deep
            bowl the share is 0.8, so the bowl counts as solid there; 0.9 leaves it empty, but then the surface must
            have no holes.
        particles_per_cell: Points in each cell of the solid without a Gaussian: 1, 8 or 27.
        jitter: Largest random shift of points from their regular positions, from 0 to 1 times their distance.
        max_radius: Longest reach of a Gaussian [cells].
        seed: Seed of the jitter.
    """

    spacing: float | None = None
    threshold: float = 0.3
    directions: int = 26
    votes: float = 0.75
    particles_per_cell: int = 1
    jitter: float = 0.5
    max_radius: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        if self.spacing is not None:
            check_positive("filling.spacing", self.spacing)
        check_positive("filling.threshold", self.threshold)
        ray_directions(self.directions)
        if not 0.5 < self.votes <= 1:
            raise ValueError(f"Expected `filling.votes` to be above 0.5 and at most 1, but got {self.votes}.")
        if self.particles_per_cell not in (1, 8, 27):
            raise ValueError(
                f"Expected `filling.particles_per_cell` to be 1, 8 or 27, but got {self.particles_per_cell}."
            )
        if not 0 <= self.jitter <= 1:
            raise ValueError(f"Expected `filling.jitter` to be from 0 to 1, but got {self.jitter}.")
        if not 1 <= self.max_radius <= 64:
            raise ValueError(f"Expected `filling.max_radius` to be from 1 to 64 cells, but got {self.max_radius}.")

    @torch.no_grad()
    def fill(
        self,
        means: Tensor,
        covariances: Tensor,
        opacities: Tensor,
        spacing: float | None = None,
        progress: bool = True,
        chunk: int = _CHUNK,
    ) -> Filling:
        """Fill the body enclosed by some Gaussians.

        Args:
            means: Centres [m], shape (N, 3).
            covariances: Covariances [m²], shape (N, 3, 3).
            opacities: Opacities from 0 to 1, shape (N,).
            spacing: Side of a cell [m], used if the object has none.
            progress: Show a progress bar if it takes more than a second.
        """
        h = self.spacing if self.spacing is not None else spacing
        assert h is not None, "the scene gives its cells"
        means, covariances, opacities = (t.detach().cpu().double() for t in (means, covariances, opacities))
        if len(means) == 0 or not bool(torch.isfinite(means).all() & torch.isfinite(covariances).all()):
            raise ValueError("Expected `means` and `covariances` to be finite and not empty; remove broken Gaussians.")
        low, resolution = grid_around(means, h)
        with tqdm(
            total=len(means) + self.directions, desc="filling", leave=False, delay=1, disable=not progress,
            file=sys.stderr, bar_format="{l_bar}{bar}| {elapsed}<{remaining}",
        ) as bar:  # fmt: skip
            density = density_grid(
                means, covariances, opacities, low, h, resolution, self.max_radius, chunk, advance=bar.update
            )
            dense = density > self.threshold
            body = dense | enclosed(dense, self.directions, self.votes, bar.update)
        cells = (means - low) / h - 0.5
        depth = sheet_depth(density, cells, covariances / h**2, self.threshold)
        on_surface = sample(depth_below(~open_air(~body), depth), cells, chunk) < depth + 1
        side = round(self.particles_per_cell ** (1 / 3))
        element = solid_elements(depth_below(body, depth) - depth, side, chunk)
        if len(element) == 0:
            raise ValueError(
                "Expected `filling` to find an inside, but no cell is enclosed: the surface is open or has holes wider "
                f"than a cell of {h:.3g} m, or the body is thinner than three cells; change `filling.spacing`, lower "
                "`filling.threshold` or `filling.votes`, or remove `filling` for a shell."
            )
        fine = torch.tensor(resolution) * side
        owner, filled = assign(means, element, low, h / side, fine)
        volume, gaussian_volume = share_volume(owner, filled, (h / side) ** 3)
        generator = torch.Generator().manual_seed(self.seed)
        draw = torch.rand(int(filled.sum()), 3, generator=generator, dtype=torch.float64) - 0.5
        position = low + (unravel(element[filled], fine) + 0.5 + self.jitter * draw) * (h / side)
        return Filling(position, volume, gaussian_volume, on_surface)


def grid_around(means: Tensor, spacing: float) -> tuple[Tensor, tuple[int, int, int]]:
    """Lower corner [m] (3,) and resolution of a grid around points (N, 3) with six cells to spare on each side."""
    low, high = means.amin(0), means.amax(0)
    size = ((high - low) / spacing).ceil() + 1 + 2 * 6
    if float(size.prod()) > MAX_CELLS:
        raise ValueError(
            f"Expected `filling.spacing` to give at most {MAX_CELLS:,} cells, but {spacing:.3g} m gives "
            f"{float(size.prod()):,.0f} for an object of {[round(v, 3) for v in (high - low).tolist()]} m: raise it, "
            "or exclude stray Gaussians from the region."
        )
    nx, ny, nz = (int(n) for n in size.tolist())
    # a quarter of a cell off the middle: if one face of a box is rounded up, the opposite one is rounded down
    return 0.5 * (low + high) - spacing * (0.5 * size + 0.25), (nx, ny, nz)


def unravel(index: Tensor, resolution: Tensor) -> Tensor:
    """Indices along x, y and z (M, 3) of elements given by one number (M,), z fastest."""
    _, ny, nz = resolution.tolist()
    return torch.stack([index // (ny * nz), index // nz % ny, index % nz], dim=-1)


def solid_elements(field: Tensor, side: int, chunk: int = _CHUNK) -> Tensor:
    """Elements whose centres are inside the solid; a cell has side³ of them.

    Args:
        field: Depth below the surface [cells], shape (nx, ny, nz).

    Returns:
        One number for each, z fastest, ascending, shape (K,).
    """
    fine = torch.tensor(field.shape) * side
    near = torch.nn.functional.max_pool3d(field[None, None], 3, 1, 1)[0, 0] >= 0
    inner = torch.cartesian_prod(*(torch.arange(side),) * 3).reshape(-1, 3)
    found = []
    for cells in near.nonzero().split(max(1, chunk // side**3)):
        part = (cells[:, None] * side + inner).reshape(-1, 3)
        inside = sample(field, (part + 0.5) / side - 0.5) >= 0
        part = part[inside]
        found.append((part[:, 0] * fine[1] + part[:, 1]) * fine[2] + part[:, 2])
    return torch.cat(found).sort().values if found else torch.zeros(0, dtype=torch.long)


def assign(means: Tensor, element: Tensor, low: Tensor, spacing: float, resolution: Tensor) -> tuple[Tensor, Tensor]:
    """The element of the solid of each Gaussian, and which elements need an extra point.

    A Gaussian belongs to the element that it is in, or else to the nearest one within 1.5 spacings. An element that
    contains the centre of a Gaussian needs no extra point.

    Args:
        means: Centres [m], shape (N, 3).
        element: From :func:`solid_elements`, shape (K,).
        low: Lower corner of the grid [m], shape (3,).
        spacing: Side of an element [m].
        resolution: Elements along x, y and z, shape (3,).

    Returns:
        Index into ``element`` or -1, shape (N,), and booleans, shape (K,).
    """
    x, y, z = ((means - low) / spacing).floor().long().unbind(-1)
    key = (x * resolution[1] + y) * resolution[2] + z
    at = torch.searchsorted(element, key).clamp_max(len(element) - 1)
    owner = torch.where(element[at] == key, at, -1)
    filled = torch.ones(len(element), dtype=torch.bool)
    filled[owner[owner >= 0]] = False
    astray = (owner < 0).nonzero()[:, 0]
    centre = low + (unravel(element, resolution) + 0.5) * spacing
    distance, nearest = nearest_neighbours(centre, 1, means[astray])
    owner[astray] = torch.where(distance[:, 0] <= 1.5 * spacing, nearest[:, 0], -1)
    return owner, filled
