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
from gaussian_swaying.gaussians.hold import columns
from gaussian_swaying.gaussians.measures import Array, extent, quantile
from gaussian_swaying.mpm.modal import SHIFT, Structure, analysis_of, factor, rayleigh
from gaussian_swaying.mpm.modes import MOST_MODES, Modes
from gaussian_swaying.mpm.pins import NODE_SHARE
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.kinds import KINDS, Kind
from gaussian_swaying.suggestion.stretch import cloth_motion, linear_motion, rate_for, typical_start
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
    """Stiffness, mass and drag of a thing that sways as its kind does.

    Attributes:
        height: Height [m], or length from the pivot to the centre of mass of a hanging thing, that decides its
            frequency.
        frequency: First frequency in still air [Hz].
        mass: Mass of what moves [kg].
        frontal: Area of its silhouette in the wind [m²].
        thicker: Factor on the thicknesses of the surface.
        stiffer: New Young's moduli [Pa], keyed by the old ones.
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
    """Find stiffness, mass and drag for a kind, and apply them to the simulation.

    Args:
        flow: Mean wind [m/s], z up, shape (3,).

    Raises:
        ValueError: If nothing holds it.
    """
    scene, model, solver = simulation.scene, simulation.model, simulation.solver
    assert isinstance(solver, MPMSolver)
    structure = Structure(Total(model.points, solver.framed(scene.frame), model.solver))
    free = structure.pinned[structure.table].max(1) < 0
    free = free if free.any() else np.ones(len(free), bool)
    height = _height(structure, free, kind)
    frequency, blows = kind.first_frequency(height), bool(flow.any())
    square = (2 * math.pi * frequency) ** 2
    along = flow.double().cpu() if blows else torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)  # it is still
    frontal = silhouette(structure.rest[free], along.numpy())
    own, wanted = float(model.points.mass.double().sum()), kind.area_mass(height) * frontal
    thicker = wanted / (own * float(structure.point_mass[free].sum()))
    found = _stiffness(structure, model.points.youngs_modulus, own * thicker, thicker, frequency, kind)
    stiffer = {value: value * ratio for value, ratio in found.items()}
    drag, coefficient = _drag(simulation, frontal, along, kind), kind.drag
    aero, mean = _with_drag(simulation.aero, drag), flow * math.sqrt(1 + intensity**2)
    leans = blows and kind not in (KINDS["hanging"], KINDS["rigid"])
    bound: Modes | None = None
    for repeated in (False, True):  # the second time the mode itself has the frequency; the shapes stay
        points = model.points
        E = points.youngs_modulus.clone()
        for value, modulus in stiffer.items():
            E[points.youngs_modulus == value] = modulus
        points = replace(points, mass=points.mass * thicker, volume=points.volume * thicker, youngs_modulus=E)
        simulation.adopt(model.replace(points=points, aero=aero))
        if not repeated:
            volume = points.volume.double()
            unit = float(points.mass.double().sum() / ((E * volume).sum() / volume.sum()))
            whole = Total(points, solver.framed(scene.frame), model.solver)
            analysis_of(whole, 0, MOST_MODES, unit * square)  # is in the cache now
        simulation.solver.init_state(points, frame=scene.frame)
        assert isinstance(solver.bound, Modes)
        bound = solver.bound
        used, ratio = stiffer, square / bound.first**2
        stiffer = {value: modulus * ratio for value, modulus in stiffer.items()}
        if leans:
            top = 0.5 * aero.air_density * kind.drag * float(mean.square().sum())
            top /= TIP * kind.area_mass(height) * square
            little = math.sqrt(LITTLE * height / top)  # of the wind, in which the lean is linear
            _, moved, _ = _top(scene, bound.leaning(WindForce(aero, WindField(mean * little), scene.patches)))
            change = min(max(top * little**2 * ratio / max(moved, 1e-30), 1 / MOST_CHANGE), MOST_CHANGE)
            aero, leans, drag, coefficient = _with_drag(aero, change), False, drag * change, coefficient * change
    lean, start = 0.0, 0.0
    if blows and bound is not None:
        steady, wind = WindForce(aero, WindField(mean), scene.patches), simulation.wind
        highest, moved, side = _top(scene, bound.leaning(steady))
        share = torch.bincount(bound.site[scene.owner[highest]], minlength=bound.sites).double().cpu() / len(highest)
        assert isinstance(wind, WindField)
        lean = moved / side
        start = typical_start(linear_motion(bound, steady, wind, share, rate_for(frequency)), frequency)
    return Natural(height, frequency, wanted, frontal, thicker, used, drag, coefficient, lean, start)


def cloth_start(simulation: Simulation, kind: Kind, size: Sequence[float]) -> float:
    """Time at which a typical stretch of the wind begins for a cloth [s], by its pendulum or flapping.

    Args:
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


def silhouette(place: Array, flow: Array) -> float:
    """Area of the silhouette of points [m²], shape (P, 3), seen along a level flow, shape (3,).

    Counted in square cells of at least half the distance of neighbouring points.
    """
    flat = np.c_[place[:, :2] @ [-flow[1], flow[0]] / math.hypot(*flow[:2]), place[:, 2]]
    side = np.ptp(flat, axis=0).max()
    cell = side / SILHOUETTE
    while True:  # coarser, until the cells of a closed surface are mostly full
        count = len(np.unique(columns(flat, cell)))
        if cell >= side or len(flat) > 3 * count:
            return float(count * cell**2)
        cell *= 1.25


def _height(structure: Structure, free: Array, kind: Kind) -> float:
    """The length that decides the frequency [m]."""
    z, held = structure.rest[:, 2], not free.all()
    if kind is KINDS["hanging"]:
        middle = np.average(z[free], weights=structure.point_mass[free])
        return max(float(z[~free].min() if held else z.max()) - float(middle), 1e-3)
    foot = quantile(z[~free], 0.95) if held else float(z.min())
    return max(quantile(z[free], 0.99) - foot, 1e-3)


def _stiffness(
    structure: Structure, modulus: Tensor, mass: float, thicker: float, frequency: float, kind: Kind
) -> dict[float, float]:
    E = modulus.double().cpu().numpy()
    values = np.unique(E)
    target, load = (2 * math.pi * frequency) ** 2, structure.loads(0)[:, :2]
    unit = mass / (structure.mean_modulus * thicker)  # of squares of frequencies, for the structure's own units

    def quotient(whole: Any) -> float:
        K, M = structure.reduced(structure.with_rows(whole))
        return rayleigh(K, M, factor(K + SHIFT**2 * target * unit * M)(structure.spread.T @ load)) / unit

    if len(values) == 1:
        whole, stem = structure.hooke(), 1.0
        for _ in range(3):  # the shift is that of the stiffness found
            stem *= target / quotient(stem * whole)
        leaf = stem
    else:
        soft = values[0] == E  # leaves have the lowest modulus
        leaves, stems = structure.hooke(soft), structure.hooke(~soft)
        wanted = (2 * math.pi * max(kind.leaf, ABOVE * frequency)) ** 2 * unit
        leaf = stem = wanted / _on_pinned_stems(structure, leaves, soft, wanted)
        low, high = 1e-6, 1e12
        for _ in range(8):
            found = quotient(leaf * leaves + stem * stems)
            if abs(found / target - 1) < 0.1:  # the mode itself will be exact
                break
            low, high = (stem, high) if found < target else (low, stem)
            following = stem * (target / found) ** 1.3
            stem = following if low < following < high else math.sqrt(low * high)
    if not 1e-9 < stem < 1e9:
        raise ValueError(
            "Most of it hangs loose, so that no stiffness gives it the frequency of its kind: hold more of it."
        )
    return {float(value): leaf if value == values[0] else stem for value in values}


def _on_pinned_stems(structure: Structure, leaves: Any, soft: Array, target: float) -> float:
    """Rayleigh's quotient of the leaves with all nodes pinned that carry more than a little of the stems."""
    import scipy.sparse as sparse

    share = structure.value.T @ (structure.point_mass * ~soft)
    nodes = (
        (share <= NODE_SHARE * structure.mass) & (structure.pinned < 0) & (structure.mass > 1e-7 * structure.mass.max())
    )
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
    aero, position = simulation.aero, simulation.model.points.position
    still = torch.zeros_like(position)
    identity = torch.eye(3).to(still).expand(*still.shape, 3)
    direction = flow.to(still) / flow.to(still).norm()
    lost = torch.zeros(len(still), dtype=torch.bool, device=still.device)
    time = torch.zeros((), dtype=torch.float64, device=still.device)
    state = State(position=position, velocity=still, F_elastic=identity, F_total=identity, lost=lost, time=time)
    force = WindForce(aero, WindField(direction.double()), simulation.scene.patches)(state)[0]
    return kind.drag * 0.5 * aero.air_density * frontal / max(float((force.sum(0) * direction).sum()), 1e-30)


def _with_drag(aero: AeroForce, factor: float) -> AeroForce:
    return changed(aero, **{name: factor * getattr(aero, name) for name in ("C_D", "C_F", "C_L")})


def _top(scene: SimulatedScene, state: State) -> tuple[Tensor, float, float]:
    """The tenth of the Gaussians that moves most, its mean displacement, and the longest side of what moves [m]."""
    size = scene.follow.motion(state)[0].norm(dim=-1)
    moving = (size > 0.1 * quantile(size.cpu().numpy(), 0.98)).nonzero()[:, 0]
    if len(moving) == 0:
        return torch.arange(len(size), device=size.device), 0.0, 1.0
    top = moving[size[moving] >= quantile(size[moving].cpu().numpy(), 0.9)]
    rest = scene.model.means.detach()[scene.moving[moving]].double().cpu().numpy() * scene.frame.metres_per_unit
    return top, float(size[top].mean()), max(extent(rest, 0.01), 1e-30)
