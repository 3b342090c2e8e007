r"""Crowns whose branches bend in the wind: how their drag grows with its speed.

Drag that grows as :math:`U^{2 - n}` has the n of tables of trees. A crown is a stem, which is held, with straight
branches of one section. Foliage catches the wind over a width along each branch, and only the flow across the
branch presses it, as it is free to turn about it. The exact drag is the sum of that of elasticas: a branch and the wind
lie in a plane, in which it bends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from bench.problems.beams import Chosen
from bench.problems.rods import section
from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

AIR, C_D = 1.225, 1.0  # kg/m³
WOOD_E = 8e9  # Pa; green wood
YOUNG = 2e8
"""Modulus of the branches in the simulation [Pa]: their section has the bending stiffness of the wood, and is wider."""
AROUND, PER_CELL, HELD = 8, 4, 2


@dataclass(frozen=True)
class Crown:
    """A crown of equal branches.

    Attributes:
        length: Of a branch [m].
        diameter: Of its wood [m].
        width: Over which its foliage catches the wind [m].
        rise: Angle of the branches above the horizontal [degrees].
        exponent: n of the species in the table of the ForestGALES model.
    """

    length: float
    diameter: float
    width: float
    rise: float
    exponent: float

    @property
    def stiffness(self) -> float:
        """Bending stiffness of a branch [N m²]."""
        return WOOD_E * math.pi * self.diameter**4 / 64

    def cauchy(self, speed: float) -> float:
        r""":math:`\tfrac12 \rho C_D w U^2 l^3 / EI`."""
        return 0.5 * AIR * C_D * self.width * speed**2 * self.length**3 / self.stiffness

    def ways(self, branches: int) -> np.ndarray:
        """Unit vectors along the branches, in the golden angle from each to the next, shape (branches, 3)."""
        turn = 2.39996 * np.arange(branches) + 0.3
        rise = math.radians(self.rise)
        flat = math.cos(rise)
        return np.stack([flat * np.cos(turn), flat * np.sin(turn), np.full(branches, math.sin(rise))], 1)


CROWNS = {
    "Sitka spruce": Crown(1.5, 0.015, 0.35, -10.0, 0.51),
    "birch": Crown(1.5, 0.011, 0.35, 50.0, 0.881),
}


def branch_drag(cauchy: Sequence[float], lean: float) -> list[float]:
    r"""Drag of a branch along the wind over :math:`\tfrac12 \rho C_D w l U^2`, at ascending Cauchy numbers.

    An inextensible elastica under the pressure :math:`C \cos\theta` across itself, where :math:`\theta` is its angle
    from the direction across the flow: as in :mod:`~bench.problems.reconfiguration`, but clamped at an angle. It is
    followed from no wind, so that of several solutions it is that to which the branch bends.

    Units: ``lean`` [rad].
    """
    from scipy.integrate import solve_ivp
    from scipy.optimize import fsolve

    def from_the_tip(tip: float, c: float) -> np.ndarray:
        def bent(_: float, y: np.ndarray) -> list[float]:
            angle, moment, across, along = y  # over the distance from the tip
            cos, sin = math.cos(angle), math.sin(angle)
            return [-moment, across * cos - along * sin, c * cos * cos, -c * cos * sin]

        return solve_ivp(bent, (0, 1), [tip, 0, 0, 0], rtol=1e-8, atol=1e-10).y[:, -1]

    found, tip, before = [], lean, 0.0
    for c in cauchy:
        for part in np.geomspace(max(before, 0.1), c, 12):
            tip = float(fsolve(lambda t, part=part: from_the_tip(float(t[0]), part)[0] - lean, tip)[0])
        found.append(float(from_the_tip(tip, c)[2]) / c)
        before = c
    return found


def exponent(speeds: Sequence[float], drags: Sequence[float]) -> float:
    """The n of a drag that grows as U^(2 - n), by least squares of the logarithms."""
    return 2.0 - float(np.polyfit(np.log(speeds), np.log(drags), 1)[0])


SPEEDS = (10.0, 15.0, 20.0, 25.0)
"""Of the wind [m/s]."""


def elastica_drags(kind: Crown, speeds: Sequence[float], branches: int) -> np.ndarray:
    """Drag of a crown of elasticas in ascending winds [N]."""
    cauchy = [kind.cauchy(speed) for speed in speeds]
    each = sum(np.array(branch_drag(cauchy, math.asin(way[0]))) for way in kind.ways(branches))
    return 0.5 * AIR * C_D * kind.width * kind.length * np.array(speeds) ** 2 * each


def crown(
    species: str,
    speeds: Sequence[float] = SPEEDS,
    cells: int = 16,
    branches: int = 12,
    settle: float = 12.0,
    settings: Settings | None = None,
) -> Result:
    """Let the branches of a crown come to rest in winds of some speeds, and fit the exponent of its drag.

    Units: ``speeds`` [m/s].

    Returns:
        ``error`` (of the drag at the last speed, relative to the elasticas), ``exponent``, ``elastica`` (that of the
        elasticas), ``known`` (that of the table), ``drift`` (relative change of the drag in the last eighth of the
        time, at worst), ``R_10`` and so on (drag over that of the crown at rest), ``exact_10`` and so on (those of the
        elasticas) and the common quantities of the last run.
    """
    settings = Settings() if settings is None else settings
    kind = CROWNS[species]
    dx = kind.length / cells
    thick = (64 * kind.stiffness / (math.pi * YOUNG)) ** 0.25
    ways = kind.ways(branches)
    along = (np.arange(-HELD * PER_CELL, cells * PER_CELL) + 0.5) / PER_CELL * dx
    ring = section(thick, AROUND).numpy()
    place, first, second = [], [], []
    for number, way in enumerate(ways):
        side = np.cross(way, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(way, [0.0, 0.0, 1.0]))
        frame = np.stack([side, np.cross(way, side)])
        foot = np.array([0.0, 0.0, 6 * dx * number])
        place.append((foot + along[:, None] * way)[:, None] + ring @ frame)
        first.append(np.broadcast_to(frame[0], place[-1].shape))
        second.append(np.broadcast_to(frame[1], place[-1].shape))
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    body, one, other = (torch.tensor(np.array(part).reshape(-1, 3)).to(like) for part in (place, first, second))
    free = torch.tensor(np.tile(np.repeat(along > 0, AROUND), branches))
    branch = torch.arange(branches).repeat_interleave(len(along) * AROUND)
    step = dx / PER_CELL / AROUND
    speed = max(speeds)
    # so heavy that the drag damps the lowest mode critically in the strongest wind
    mass = (0.5 * AIR * C_D * kind.width * speed * kind.length**2 / 3.516) ** 2 / kind.stiffness
    mass *= min(1.0, 30 / kind.cauchy(speed))
    area = math.pi * thick**2 / 4
    points = MaterialPoints.create(body, volume=area * step, density=mass / area, youngs_modulus=YOUNG,
                                   poisson_ratio=0.0, attached=branch)  # fmt: skip
    omega = 3.516 / kind.length**2 * math.sqrt(kind.stiffness / mass)
    patch = torch.where(free, kind.width * step, 0.0).to(like)
    drags, drift = [], 0.0
    for speed in speeds:
        wind = WindField([speed, 0.0, 0.0])
        aero = AeroForce(C_D=C_D, C_F=0.0, C_L=0.0, air_density=AIR, law="projected")
        forces = [WindForce(aero, wind, normal, patch).to(body.device) for normal in (one, other)]
        pins = [PinnedRegion(Chosen(~free), "clamp")]
        solver = settings.solver(dx, boundaries=pins, damping=omega * max(1.0, kind.cauchy(speed) ** (1 / 3)))

        def pushed(state: MPMState, forces: list[WindForce] = forces) -> torch.Tensor:
            return torch.stack([force(state)[0][..., 0].sum() for force in forces]).sum()

        run = follow(solver, solver.init_state(points), settle / omega / 64, 64, pushed, forces)  # type: ignore[arg-type]
        drags.append(float(run.series[-1]))
        drift = max(drift, abs(float(run.series[-1] / run.series[-9]) - 1))
    rigid = [0.5 * AIR * C_D * kind.width * kind.length * u**2 * float((1 - ways[:, 0] ** 2).sum()) for u in speeds]
    known = elastica_drags(kind, speeds, branches)
    shares = {f"R_{u:g}": drag / whole for u, drag, whole in zip(speeds, drags, rigid, strict=True)}
    exact = {f"exact_{u:g}": drag / whole for u, drag, whole in zip(speeds, known, rigid, strict=True)}
    return run.result(
        drags[-1] / known[-1] - 1,
        exponent=exponent(speeds, drags),
        elastica=exponent(speeds, list(known)),
        known=kind.exponent,
        drift=drift,
        **shares,
        **exact,
    )
