r"""Stiffness, mass and drag with which a thing sways as its kind does in nature, by linear algebra in place of trials.

First frequency :math:`\omega_1` and mass per frontal area :math:`M_A` alone decide how far a thing leans in a wind U,
by :math:`\rho C_D U^2 / (2 M_A \omega_1^2)`. The mass of the whole is that of the kind on the silhouette that is seen;
the stiffness of the grid that runs is scaled until the main mode of the lean has the first frequency of the kind and
height; and the drag, that of the kind on the silhouette, is scaled until the top leans as the formula says. Leaves on
stems have a frequency of their own, with the stems pinned.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.mpm.modal import SHIFT, Structure, analysis_of, factor, rayleigh
from gaussian_swaying.mpm.modes import MOST_MODES, Modes
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.preview.kinds import KINDS, Kind
from gaussian_swaying.preview.shape import extent, quantile
from gaussian_swaying.preview.stretch import cloth_motion, linear_motion, rate_for, typical_start
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce, added_mass_per_area

FLAPS, HANGS, CLOTH_RATIO = 0.35, 0.6, 0.3
"""Frequency of a flag times its length over the wind; of a hanging sheet times the root of its length; damping."""
SILHOUETTE = 96
"""Cells along the longest side in which the silhouette is counted."""
ABOVE = 1.5
"""Least frequency of leaves on pinned stems, over that of the whole."""
TIP, LITTLE, MOST_CHANGE = 0.7, 0.02, 2.5
"""Mean displacement over that of the top; lean at which it is linear; largest change of the drag for a natural lean."""


@dataclass(frozen=True)
class Natural:
    """Numbers of a thing that sways as its kind does.

    Attributes:
        height: Height [m], or length from the pivot to the centre of mass of a hanging thing, that decides its
            frequency.
        frequency: First frequency in still air [Hz].
        mass: Mass of what moves [kg].
        frontal: Area of its silhouette in the wind [m²].
        thicker: Factor on the thicknesses of the surface.
        stiffer: Young's moduli [Pa], by those before.
        drag: Factor on the drag, friction and lift coefficients.
        coefficient: Drag coefficient of the whole on its silhouette.
        lean: Mean displacement of the upper tenth in the mean wind, over the longest side.
        start: Time at which a typical stretch of the turbulence begins [s].
    """

    height: float
    frequency: float
    mass: float
    frontal: float
    thicker: float
    stiffer: dict[float, float]
    drag: float
    coefficient: float
    lean: float
    start: float


def natural(simulation: Simulation, kind: Kind, flow: Tensor, intensity: float) -> Natural:
    """Find the numbers of a kind for a scene, and give them to the simulation.

    Args:
        simulation: The scene in the formulation ``modes``, with any stiffness, thickness and drag; it is changed.
        kind: Its kind, no cloth.
        flow: Mean wind [m/s], z up, shape (3,).
        intensity: Intensity of its turbulence.

    Raises:
        ValueError: If nothing holds it.
    """
    scene, model = simulation.scene, simulation.model
    solver = simulation.solver
    assert isinstance(solver, MPMSolver)
    total = Total(model.points, solver.framed(scene.frame), model.solver)
    structure = Structure(total)
    place = structure.rest
    free = structure.pinned[structure.table].max(1) < 0
    free = free if free.any() else np.ones(len(place), bool)
    height = _height(structure, free, kind)
    frequency = kind.first_frequency(height)
    assert frequency is not None
    along = flow if bool(flow.any()) else torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)  # it is still
    frontal = silhouette(torch.from_numpy(place[free]), along)
    moving = float(structure.point_mass[free].sum())
    own = float(model.points.mass.double().sum())
    wanted = kind.area_mass(height) * frontal
    thicker = wanted / (own * moving)
    found = _stiffness(structure, model.points.youngs_modulus, own * thicker, thicker, frequency, kind)
    stiffer = {value: value * ratio for value, ratio in found.items()}
    drag = _drag(simulation, frontal, along, kind)
    aero, coefficient = _with_drag(simulation.aero, drag), kind.drag
    mean = flow * math.sqrt(1 + intensity**2)
    used, leans = stiffer, bool(flow.any()) and kind not in (KINDS["hanging"], KINDS["rigid"])
    modes: Modes | None = None
    for _ in range(2):  # the second time the mode itself has the frequency; the shapes stay
        points = model.points
        E = points.youngs_modulus.clone()
        for value, modulus in stiffer.items():
            E[points.youngs_modulus == value] = modulus
        points = replace(points, mass=points.mass * thicker, volume=points.volume * thicker, youngs_modulus=E)
        simulation.adopt(model.replace(points=points, aero=aero))
        if used is stiffer:
            whole = Total(points, solver.framed(scene.frame), model.solver)
            volume, whole_mass = points.volume.double(), points.mass.double().sum()
            unit = float(whole_mass / ((points.youngs_modulus * volume).sum() / volume.sum()))
            analysis_of(whole, 0, MOST_MODES, unit * (2 * math.pi * frequency) ** 2)  # is in the cache now
        simulation.solver.init_state(points, frame=scene.frame)
        bound = solver.bound
        assert isinstance(bound, Modes)
        used, modes = stiffer, bound
        ratio = (2 * math.pi * frequency) ** 2 / bound.first**2
        stiffer = {value: modulus * ratio for value, modulus in stiffer.items()}
        if leans:
            top = 0.5 * aero.air_density * kind.drag * float(mean.square().sum())
            top /= TIP * kind.area_mass(height) * (2 * math.pi * frequency) ** 2
            little = math.sqrt(LITTLE * height / top)  # of the wind, in which the lean is linear
            _, moved, _ = _top(scene, modes.leaning(WindForce(aero, WindField(mean * little), scene.patches)))
            moved /= little**2 * ratio
            change = min(max(top / max(moved, 1e-30), 1 / MOST_CHANGE), MOST_CHANGE)
            aero, leans = _with_drag(aero, change), False
            drag, coefficient = drag * change, coefficient * change
    assert modes is not None
    lean, start = 0.0, 0.0
    if bool(flow.any()):
        steady = WindForce(aero, WindField(mean), scene.patches)
        highest, moved, side = _top(scene, modes.leaning(steady))
        lean = moved / side
        share = torch.bincount(modes.site[scene.owner[highest]], minlength=modes.sites).double().cpu() / len(highest)
        assert isinstance(simulation.wind, WindField)
        start = typical_start(linear_motion(modes, steady, simulation.wind, share, rate_for(frequency)), frequency)
    return Natural(height, frequency, wanted, frontal, thicker, used, drag, coefficient, lean, start)


def cloth_start(simulation: Simulation, kind: Kind, size: Sequence[float]) -> float:
    """Time at which a typical stretch of the wind begins for a cloth [s], by its pendulum or flapping.

    Args:
        simulation: The scene.
        kind: ``cloth`` or ``flag``.
        size: Sides of the cloth [m], z up.
    """
    wind, aero = simulation.wind, simulation.aero
    if not isinstance(wind, WindField) or wind.uniform or not bool(wind.flows.any()):
        return 0.0
    frequency = FLAPS * float(wind.flows[0].norm()) / max(size)
    if kind is KINDS["cloth"]:
        carried = added_mass_per_area(sorted(size)[1], aero.air_density)
        frequency = HANGS / math.sqrt(size[2]) * math.sqrt(kind.mass / (kind.mass + carried))
    places = simulation.model.points.position
    places = places[:: max(1, len(places) // 8)]
    return typical_start(cloth_motion(wind, places, frequency, CLOTH_RATIO), frequency, tonal=False)


def silhouette(place: Tensor, flow: Tensor) -> float:
    """Area of the silhouette of points [m²], shape (P, 3), seen along a level flow, shape (3,).

    Counted in square cells of at least half the distance of neighbouring points.
    """
    along = torch.nn.functional.normalize(flow.double() * flow.new_tensor([1.0, 1.0, 0.0]), dim=0)
    across = torch.stack([-along[1], along[0], torch.zeros_like(along[0])])
    flat = torch.stack([place.double() @ across, place.double()[:, 2]], -1)
    side = float((flat.amax(0) - flat.amin(0)).amax())
    cell = side / SILHOUETTE
    while cell < side:  # coarser, until the cells of a closed surface are mostly full
        index = (flat / cell).floor().long()
        count = int(equal_rows(index).max()) + 1
        if len(flat) > 3 * count:
            break
        cell *= 1.25
    return count * cell**2


def _height(structure: Structure, free: np.ndarray, kind: Kind) -> float:
    """The length that decides the frequency [m]."""
    z = structure.rest[:, 2]
    if kind is KINDS["hanging"]:
        middle = float((structure.point_mass[free] * z[free]).sum() / structure.point_mass[free].sum())
        return max(float(z[~free].min() if (~free).any() else z.max()) - middle, 1e-3)
    foot = quantile(torch.from_numpy(z[~free]), 0.95) if (~free).any() else float(z.min())
    return max(quantile(torch.from_numpy(z[free]), 0.99) - foot, 1e-3)


def _stiffness(
    structure: Structure, modulus: Tensor, mass: float, thicker: float, frequency: float, kind: Kind
) -> dict[float, float]:
    """Factors on the moduli, by their values: first the leaves on pinned stems, then the stems."""
    E = modulus.double().cpu().numpy()
    values = np.unique(E)
    target = (2 * math.pi * frequency) ** 2
    unit = mass / (structure.mean_modulus * thicker)  # of squares of frequencies, for the structure's own units
    load = structure.loads(0)[:, :2]

    def quotient(*parts: tuple[float, Any]) -> float:
        whole = parts[0][0] * parts[0][1]
        for ratio, K in parts[1:]:
            whole = whole + ratio * K
        K, M = structure.reduced(structure.with_rows(whole))
        return rayleigh(K, M, factor(K + SHIFT**2 * target * unit * M)(structure.spread.T @ load)) / unit

    if len(values) == 1:
        whole = structure.hooke()
        ratio = target / quotient((1.0, whole))
        for _ in range(2):  # the shift is that of the stiffness found
            ratio *= target / quotient((ratio, whole))
        _check_loose(ratio)
        return {float(values[0]): ratio}
    soft = values[0] == E  # leaves have the lowest modulus
    leaves, stems = structure.hooke(soft), structure.hooke(~soft)
    wanted = (2 * math.pi * max(kind.leaf, ABOVE * frequency)) ** 2
    leaf = wanted * unit / _on_pinned_stems(structure, leaves, soft, wanted * unit)
    low, high, stem = 1e-6, 1e12, leaf
    for _ in range(8):
        found = quotient((leaf, leaves), (stem, stems))
        if abs(found / target - 1) < 0.1:  # the mode itself will be exact
            break
        low, high = (stem, high) if found < target else (low, stem)
        following = stem * (target / found) ** 1.3
        stem = following if low < following < high else math.sqrt(low * high)
    _check_loose(stem)
    return {float(value): leaf if value == values[0] else stem for value in values}


def _check_loose(ratio: float) -> None:
    """Raise ValueError if no stiffness gives a thing its frequency, as most of it hangs loose."""
    if not 1e-9 < ratio < 1e9:
        raise ValueError(
            "Most of it hangs loose, so that no stiffness gives it the frequency of its kind: use `--connected grid`, "
            "or hold more of it."
        )


def _on_pinned_stems(structure: Structure, leaves: Any, soft: np.ndarray, target: float) -> float:
    """Rayleigh's quotient of the leaves with all nodes pinned that carry more than a little of the stems."""
    import scipy.sparse as sparse

    share = structure.value.T @ (structure.point_mass * ~soft)
    nodes = (share <= 0.07 * structure.mass) & (structure.pinned < 0) & (structure.mass > 1e-7 * structure.mass.max())
    index = (3 * np.flatnonzero(nodes)[:, None] + np.arange(3)).ravel()
    if len(index) == 0:
        return target
    K = leaves[index][:, index].tocsc()
    M = sparse.diags(np.repeat(structure.mass, 3)[index]).tocsc()
    load, ratio = structure.loads(0)[index, :2], 1.0
    for _ in range(2):
        ratio *= target / rayleigh(ratio * K, M, factor(ratio * K + SHIFT**2 * target * M)(load))
    return target / ratio


def _drag(simulation: Simulation, frontal: float, flow: Tensor, kind: Kind) -> float:
    """Factor on the coefficients that gives the whole the drag of its kind in a wind along a flow."""
    scene, aero = simulation.scene, simulation.aero
    points = simulation.model.points
    still = torch.zeros_like(points.position)
    identity = torch.eye(3).to(still).expand(*still.shape, 3)
    direction = flow.to(still) / flow.to(still).norm()
    force = WindForce(aero, WindField(direction.double()), scene.patches)
    lost = torch.zeros(len(still), dtype=torch.bool, device=still.device)
    time = torch.zeros((), dtype=torch.float64, device=still.device)
    state = State(position=points.position, velocity=still, F_elastic=identity, F_total=identity, lost=lost, time=time)
    pull = float((force(state)[0].sum(0) * direction).sum())
    return kind.drag * 0.5 * aero.air_density * frontal / max(pull, 1e-30)


def _with_drag(aero: AeroForce, factor: float) -> AeroForce:
    """The same force with other coefficients."""
    return changed(aero, **{name: factor * getattr(aero, name) for name in ("C_D", "C_F", "C_L")})


def _top(scene: SimulatedScene, state: State) -> tuple[Tensor, float, float]:
    """The tenth of the Gaussians that moves most, its mean displacement, and the longest side of what moves [m]."""
    size = scene.follow.motion(state)[0].norm(dim=-1)
    moving = (size > 0.1 * quantile(size, 0.98)).nonzero()[:, 0]
    if len(moving) == 0:
        return torch.arange(len(size), device=size.device), 0.0, 1.0
    rest = scene.model.means.detach()[scene.moving[moving]].double() * scene.frame.metres_per_unit
    side = max(extent(rest[:, k], 0.01) for k in range(3))
    top = moving[size[moving] >= quantile(size[moving], 0.9)]
    return top, float(size[top].mean()), max(side, 1e-30)
