"""The size of an object and of its grid: a spacing that suits both, and no Gaussian far away from all others."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.geometry.neighbours import nearest_neighbours

_SAMPLE = 100_000  # Gaussians that are sorted, at most
_FEW = 16  # fewer Gaussians are not checked
FAR, TOO_FAR = 20, 1000  # multiples of the side of the box around 98 % of the Gaussians
COARSE, SHORT, TOO_SHORT = 10.0, 3.0, 0.5  # cells along the longest side
NARROW, ROUND, BENT = (0.25, 4.0), 0.5, 0.2  # cells across a tube; least side over middle side; motion over length
SPARSE = 0.75  # cells between neighbouring Gaussians
_SPACED = 4096  # Gaussians whose nearest neighbour is searched


def check_extent(means: Tensor, metres_per_unit: float, dx: float, index: Tensor | None = None) -> None:
    """Refuse an object whose size comes from a stray Gaussian, or that is far too small for the grid.

    Args:
        means: Centres of the simulated Gaussians [scene units], shape (N, 3).
        metres_per_unit: Length of a scene unit [m].
        dx: Grid spacing [m].
        index: Indices of the Gaussians in the splat, for the message, shape (N,).
    """
    if len(means) < _FEW:
        return
    some = means[:: -(-len(means) // _SAMPLE)].double().sort(dim=0).values
    low, high = some[int(0.01 * len(some))], some[-1 - int(0.01 * len(some))]
    most = float((high - low).amax())
    whole = float((means.amax(0) - means.amin(0)).amax())
    if most > 0 and whole > FAR * most:
        away = (means.double() - 0.5 * (low + high)).abs().amax(-1)
        first = int(away.argmax())
        number = first if index is None else int(index[first])
        text = (
            f"Gaussian {number} lies at {[float(f'{v:.4g}') for v in means[first].tolist()]}, but 98 % of those "
            f"simulated lie within {most:.3g} scene units, so size and mass would come from empty space: leave "
            "it out with `scene.region` or `scene.opacity_threshold`."
        )
        if whole > TOO_FAR * most:
            raise ValueError(text)
        warnings.warn(text, UserWarning, stacklevel=2)
    side = whole * metres_per_unit
    if side < SHORT * dx:
        text = f"The object is {_cells(side, dx)}, so it can hardly bend: {_finer(side)}."
        if side < TOO_SHORT * dx:
            raise ValueError(text)
        warnings.warn(text, UserWarning, stacklevel=2)


def coarse(side: float, dx: float) -> list[str]:
    """A sentence about the grid of a run if the object has so few cells that a finer grid would move it otherwise.

    Args:
        side: Longest side of the object [m].
        dx: Grid spacing [m].
    """
    if not SHORT * dx <= side < COARSE * dx:  # shorter ones are warned of at the start
        return []
    return [f"The object is {_cells(side, dx)}: on a finer grid it may move a quarter more, or less; {_finer(side)}."]


def narrow(points: Tensor, dx: float, moved: float) -> list[str]:
    """A sentence about a tube that is bent and has few cells across, so that the grid decides whether it flattens.

    Args:
        points: Rest positions of the points of a body that is not filled [m], shape (P, 3).
        dx: Grid spacing [m].
        moved: Largest displacement over the longest side.
    """
    if len(points) < _FEW or not moved > BENT:
        return []
    centred = (points[:: -(-len(points) // _SAMPLE)]).double()
    centred = centred - centred.mean(0)
    turned = centred @ torch.linalg.eigh(centred.T @ centred).eigenvectors
    least, middle, _ = (turned.amax(0) - turned.amin(0)).sort().values.tolist()
    if least < ROUND * middle or not NARROW[0] * dx <= middle < NARROW[1] * dx:
        return []
    return [
        f"The object is hollow and {_cells(middle, dx, 'across')}: on a finer grid its section may flatten, and it "
        f"bends more; lower `solver.dx` to about {middle / 6:.2g} m, and set `scene.filling` if it is solid."
    ]


def _cells(side: float, dx: float, way: str = "long") -> str:
    return f"{side:.3g} m {way}, {side / dx:.2g} cells of `solver.dx` = {dx:g} m"


def _finer(side: float) -> str:
    return f"lower `solver.dx` to about {side / 24:.2g} m, or check `scene.longest_side` or `scene.metres_per_unit`"


def check_density(means: Tensor, metres_per_unit: float, dx: float) -> None:
    """Warn of a grid that is too fine for the Gaussians, whose material is then too soft.

    Args:
        means: Centres of the simulated Gaussians [scene units], shape (N, 3).
        metres_per_unit: Length of a scene unit [m].
        dx: Grid spacing [m].

    Warns:
        UserWarning: If half of them are farther than three quarters of a cell from the nearest other one.
    """
    if len(means) < _FEW:
        return
    some = means[:: -(-len(means) // _SPACED)]
    spacing = float(nearest_neighbours(means, 2, some)[0][:, 1].median()) * metres_per_unit  # the first is itself
    if spacing > SPARSE * dx:
        warnings.warn(
            f"The Gaussians are {spacing:.3g} m apart, {spacing / dx:.2g} cells of `solver.dx` = {dx:g} m, so the "
            f"material has gaps and its stiffness is wrong: raise `solver.dx` to about {2 * spacing:.2g} m, or set "
            "`scene.particle_spacing` for points between them.",
            UserWarning,
            stacklevel=2,
        )


def suggest_spacing(longest_side: float, spacing: float, cells: int) -> float:
    """Grid spacing: the longest side over ``cells``, at least twice the particle spacing, rounded to 2 digits.

    Args:
        longest_side: Longest side of the object [m].
        spacing: From :func:`~gaussian_swaying.geometry.neighbours.particle_spacing` [m].
        cells: Cells along the longest side.

    Returns:
        Grid spacing [m].
    """
    check_positive("longest_side", longest_side)
    return float(f"{max(longest_side / cells, 2 * spacing):.2g}")
