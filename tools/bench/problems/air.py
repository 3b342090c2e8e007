"""Flows with known solutions, in the computed air alone: no body moves in them.

Lengths are in sizes of the body or of the box, velocities in that of the wind, so that the Reynolds number is one over
the viscosity. Flows in a plane have one cell along y.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.air.flow import WALL, FlowState, LatticeFlow, LatticeUnits
from gaussian_swaying.air.immersed import exchange
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.kernels.graphs import Replayed
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.computed_air import ComputedAir
from gaussian_swaying.wind.field import FlowKey, WindField
from gaussian_swaying.wind.force import AeroForce

GHIA = {
    0.0547: -0.03717, 0.1016: -0.06434, 0.1719: -0.10150, 0.2813: -0.15662, 0.4531: -0.21090, 0.5: -0.20581,
    0.6172: -0.13641, 0.8516: 0.23151, 0.9531: 0.68717, 0.9766: 0.84123,
}  # fmt: skip
"""Velocity along the lid on the upright line through the middle of the cavity at Re 100, by height (Ghia, Ghia and Shin
1982, J. Comput. Phys. 48, table I)."""


def units_of(spacing: float, reynolds: float, lattice_speed: float = 0.1) -> LatticeUnits:
    """Units in which the wind is ``lattice_speed``, of air of density 1."""
    return LatticeUnits.at_speed(spacing, 1.0, lattice_speed=lattice_speed, viscosity=1 / reynolds, density=1.0)


def _relative(found: Tensor, exact: Tensor) -> float:
    return float((found - exact).square().mean().sqrt() / exact.square().mean().sqrt())


def taylor_green(cells: int, reynolds: float = 100.0, until: float = 0.5) -> float:
    """Relative error of decaying vortices in a periodic box of side 1; the time step shrinks with the square of a cell.

    The exact flow is u = (sin kx cos kz, 0, -cos kx sin kz) exp(-2 nu k² t), k = 2 pi.
    """
    units = units_of(1 / cells, reynolds, 0.8 / cells)
    flow = LatticeFlow((cells, 1, cells), units, faces=("periodic",) * 3, smagorinsky=0)
    axis, k = 2 * math.pi * (torch.arange(cells, dtype=torch.float64) + 0.5) / cells, 2 * math.pi
    x, z = torch.meshgrid(axis, axis, indexing="ij")
    start = torch.stack([x.sin() * z.cos(), 0 * x, -x.cos() * z.sin()])[:, :, None]
    state, tau = flow.start(start, dtype=torch.float64), units.relaxation
    state.moments[0] = 0.75 * ((2 * x).cos() + (2 * z).cos())[:, None] / units.speed**2
    strain = (k * x.cos() * z.cos() * units.dt)[:, None]
    state.moments[4] = -(1 - 1 / tau) * 2 * tau / 3 * strain  # the stress of the exact flow
    state.moments[6] = -state.moments[4]
    steps = round(until / units.dt)
    for _ in range(steps):
        state = flow.step(state)
    return _relative(flow.velocity(state), start * math.exp(-2 / reynolds * k * k * steps * units.dt))


def poiseuille(cells: int, reynolds: float = 10.0) -> float:
    """Relative error of the steady flow between two walls, at a distance of 1, that a force of all the air drives."""
    units = units_of(1 / cells, reynolds, 0.8 / cells)
    flow = LatticeFlow((4, 1, cells + 2), units, faces=("periodic", "periodic", "wall"), smagorinsky=0)
    height = (torch.arange(cells, dtype=torch.float64) + 0.5) / cells
    exact, push = 4 * height * (1 - height), 8 / reynolds
    start = torch.zeros(3, *flow.cells, dtype=torch.float64)
    start[0, :, :, 1:-1] = exact
    state = flow.start(start, dtype=torch.float64)
    for _ in range(round(2 * reynolds / math.pi**2 / units.dt)):
        state = flow.step(state, acceleration=(push, 0.0, 0.0))
    found = flow.velocity(state)[0, 0, 0, 1:-1] - 0.5 * push * units.dt  # at the time of the step
    return _relative(found, exact)


def cavity(cells: int, until: float = 25.0, reynolds: float = 100.0) -> float:
    """Largest difference from :data:`GHIA`, per speed of the lid."""
    units = units_of(1 / cells, reynolds)
    flow = LatticeFlow((cells + 2, 1, cells + 2), units, faces=("wall", "periodic", "wall"), smagorinsky=0)
    lid = torch.zeros(3, *flow.cells)
    lid[0, :, :, -1] = 1.0
    state = flow.start(wall_velocity=lid)
    state = _run(flow, state, round(until / units.dt))
    u = flow.velocity(state)[0, :, 0]
    middle = 0.5 * (u[cells // 2] + u[cells // 2 + 1])
    worst = 0.0
    for height, known in GHIA.items():
        place = height * cells + 0.5
        low = int(place)
        worst = max(worst, abs(float(torch.lerp(middle[low], middle[low + 1], place - low)) - known))
    return worst


def _run(flow: LatticeFlow, state: FlowState, steps: int, wind: Tensor | None = None) -> FlowState:
    now, spare = state.moments.clone(), torch.empty_like(state.moments)
    wind = None if wind is None else wind.to(now.device)
    for _ in range(steps):
        flow.advance(now, spare, wind)
        now, spare = spare, now
    return FlowState(now)


WIND = torch.tensor([1.0, 0.0, 0.0])


EACH = 20
"""Steps between two looks at a force on walls, which takes longer than a step."""


def _forces(flow: LatticeFlow, state: FlowState, walls: Tensor, until: float) -> Tensor:
    """Force on walls after each :data:`EACH` steps in :data:`WIND` [N], shape (times, 3), on the CPU."""
    now, spare = state.moments.clone(), torch.empty_like(state.moments)
    replayed, wind = Replayed(), WIND.to(now.device)

    def several(wind: Tensor) -> list[Tensor]:
        for _ in range(EACH // 2):
            flow.advance(now, spare, wind)
            flow.advance(spare, now, wind)
        return [flow.force_on_walls(FlowState(now), walls)]

    times = round(until / flow.units.dt / EACH)
    with torch.no_grad():
        return torch.stack([replayed("several", several, wind)[0] for _ in range(times)]).cpu()


def cylinder(
    cells: int, until: float = 140.0, reynolds: float = 100.0, length: int = 30, height: int = 24, device: str = "cpu"
) -> dict[str, float]:
    """Street of vortices behind a cylinder of wall cells: Strouhal number, mean drag and amplitude of the lift.

    Published for Re 100: a Strouhal number of 0.164 (Williamson 1989, J. Fluid Mech. 206), a drag of 1.33 to 1.35.

    Units: ``until`` [diameters over speed].
    """
    units = units_of(1 / cells, reynolds)
    x = (torch.arange(length * cells) + 0.5) / cells - 10
    z = (torch.arange(height * cells) + 0.5) / cells - height / 2

    def inside(place: Tensor) -> Tensor:
        return (place[..., 0] / cells - 10).square() + (place[..., 2] / cells - height / 2).square() < 0.25

    size = (length * cells, 1, height * cells)
    flow = LatticeFlow(size, units, faces=("open", "periodic", "open"), walls=inside, smagorinsky=0).to(device)
    walls = flow.kind == WALL
    start = torch.zeros(3, *size)
    start[0] = 1
    start[2] = 0.3 * torch.exp(-((x[:, None, None] - 1.5).square()) - z.square())
    state = _run(flow, flow.start(start.to(device)), round((until - 50) / units.dt), WIND)
    drag, lift = (_forces(flow, state, walls, 50.0) / (0.5 / cells))[:, [0, 2]].T
    frequency = _frequency(lift, EACH * units.dt)
    return {
        "strouhal": frequency, "drag": float(drag.mean()), "lift": float(lift.max() - lift.min()) / 2,
    }  # fmt: skip


def _bump(flow: LatticeFlow, cells: int, middle: tuple[float, float, float], size: float) -> Tensor:
    """A disturbance at the start, without which a symmetric wake never sheds, shape (X, Y, Z)."""
    axes = [(torch.arange(n) + 0.5) / cells - at for n, at in zip(flow.cells, middle, strict=True)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    return 0.3 * torch.exp(-(x.square() + y.square() + z.square()) / size**2)


def _frequency(values: Tensor, dt: float) -> float:
    """Mean frequency of upward crossings of the mean; 0 for fewer than two."""
    values = values - values.mean()
    at = ((values[:-1] < 0) & (values[1:] >= 0)).nonzero()[:, 0]
    if len(at) < 2:
        return 0.0
    place = at + values[at] / (values[at] - values[at + 1])
    return float((len(at) - 1) / ((place[-1] - place[0]) * dt))


def sphere(
    cells: int, until: float = 30.0, reynolds: float = 100.0, length: int = 12, width: int = 8, device: str = "cpu"
) -> dict[str, float]:
    """Drag of a sphere of wall cells; 1.09 at Re 100 (Clift, Grace and Weber 1978, standard drag curve).

    Units: ``until`` [diameters over speed].
    """
    units = units_of(1 / cells, reynolds)
    middle = torch.tensor([length / 3, width / 2, width / 2], dtype=torch.float64)

    def inside(place: Tensor) -> Tensor:
        return (place / cells - middle).square().sum(-1) < 0.25

    flow = LatticeFlow((length * cells, width * cells, width * cells), units, walls=inside, smagorinsky=0)
    flow.to(device)
    walls = flow.kind == WALL
    state = _run(flow, flow.start([1.0, 0.0, 0.0]), round((until - 2) / units.dt), WIND)
    force = _forces(flow, state, walls, 2.0)[:, 0].mean()
    return {"drag": float(force) / (math.pi / 8)}


def plate(
    cells: int, until: float = 40.0, reynolds: float = 300.0, length: int = 12, width: int = 8, device: str = "cpu"
) -> dict[str, float]:
    """Mean drag of a square plate across the flow; 1.17 at high Reynolds numbers (Hoerner 1965).

    The drag is the mean over the second half of the time. An immersed surface acts as if it were about half a cell
    larger at each of its edges.

    Units: ``until`` [sides over speed].
    """
    units = units_of(1 / cells, reynolds)
    flow = LatticeFlow((length * cells, width * cells, width * cells), units, smagorinsky=0).to(device)
    many = 2 * cells
    side = (torch.arange(many) + 0.5) / many - 0.5
    y, z = torch.meshgrid(side, side, indexing="ij")
    place = torch.stack([torch.full_like(y, 4.0), y + width / 2, z + width / 2], -1).reshape(-1, 3) * cells - 0.5
    area, mass = torch.full((many**2,), (cells / many) ** 2), torch.full((many**2,), 1e9)
    still = torch.zeros(many**2, 3)
    place, area, mass, still, wind = (given.to(device) for given in (place, area, mass, still, WIND))
    start = torch.zeros(3, *flow.cells)
    start[0], start[1] = 1.0, _bump(flow, cells, (5.0, width / 2 + 0.3, width / 2 + 0.1), 0.8)
    start[2] = 0.5 * start[1]
    now = flow.start(start.to(device)).moments
    spare, replayed = torch.empty_like(now), Replayed()

    def two(wind: Tensor) -> list[Tensor]:
        taken = torch.zeros((), dtype=torch.float64, device=wind.device)
        for first, second in ((now, spare), (spare, now)):
            taken = taken + exchange(first, still, area, mass, place, flow.kind)[:, 0].double().sum()
            flow.advance(first, second, wind)
        return [taken / 2]

    with torch.no_grad():
        taken = torch.stack([replayed("two", two, wind)[0] for _ in range(round(until / units.dt / 2))])
    scale = units.cell_mass * units.speed / units.dt / 0.5
    return {"drag": float(taken[len(taken) // 2 :].mean()) * scale}


def step(cells: int, reynolds: float = 200.0, until: float = 60.0) -> dict[str, float]:
    """Length of the bubble behind a step of half the height of a channel, in heights of the step.

    Published for an expansion of 2 and a Reynolds number of 200, of the mean speed and twice the height of the inlet:
    4.982 (Erturk 2008, Computers & Fluids 37).
    """
    units, before, length = units_of(1 / cells, reynolds, 0.07), 2, 10
    size = (length * cells, 1, cells + 2)
    raised = torch.zeros(size, dtype=torch.bool)
    raised[: before * cells, :, : cells // 2 + 1] = True
    flow = LatticeFlow(size, units, faces=("open", "periodic", "wall"), walls=raised, smagorinsky=0)
    height = (torch.arange(cells + 2) - 0.5) / cells
    inlet = (24 * (height - 0.5) * (1 - height)).clamp(min=0)
    outlet = (3 * height * (1 - height)).clamp(min=0)
    start = torch.zeros(3, *size)
    start[0, : before * cells], start[0, before * cells :] = inlet, outlet
    held, deep = flow.held.long(), size[2]
    wind = torch.zeros(len(held), 3)
    wind[:, 0] = torch.where(held // deep == 0, inlet[held % deep], outlet[held % deep])
    state, inner = flow.start(start), slice(cells // 2 + 1, cells + 1)
    for _ in range(round(until)):  # the face lets sound out, so the pressure of the channel slows the inlet a little
        state = _run(flow, state, round(1 / units.dt), wind)
        wind[held // deep == 0] /= flow.velocity(state)[0, cells, 0, inner].mean()
    near = flow.velocity(state)[0, before * cells :, 0, 1]
    back = int((near < 0).nonzero().max())
    share = float(near[back] / (near[back] - near[back + 1]))
    return {"bubble": 2 * (back + 0.5 + share) / cells}


def square_flag(cells: int = 20, until: float = 24.0, width: int = 4, device: str = "cpu") -> dict:
    """A square flag in three dimensions, as a sheet of the package: Re 200, mass ratio 1, bending stiffness 0.0001.

    Published: an amplitude from peak to peak of 0.78 and a frequency of 0.26 (Huang and Sung 2010, J. Fluid Mech. 653),
    0.81 and 0.27 (Tian and others 2014, J. Comput. Phys. 258), of the middle of the free edge.

    Units: ``until`` [sides over speed]; ``width`` [sides].
    """
    points = 2 * math.ceil(0.6 * cells)  # closer than the cells, and two to a cell of the grid
    simulation = Simulation(
        Scene(generator=FlagScene(width=1.0, height=1.0, spacing=1 / points), layers=1),
        Material(E=1e5, nu=0.3, density=100.0, thickness=0.01, bending=1e-4),
        solver=MPMSolver(
            dx=2 / points,
            gravity=[0.0, 0.0, 0.0],
            boundaries=[PinnedRegion(Box([None, None, None], [0.7 / points, None, None]))],
        ),
        wind=WindField(schedule=[FlowKey(0.0, [1.0, 0.3, 0.0]), FlowKey(1.0, [1.0, 0.0, 0.0])]),
        aero=AeroForce(air_density=1.0),
        air=ComputedAir(
            [-1.5, -width / 2, -1.0],
            [4.5, width / 2, 1.0],
            max(6, width) * cells,
            viscosity=1 / 200,
            smagorinsky=0,
            speed=1.2,
        ),
        frame_dt=0.05,
        device=device,
    )
    stepper, tips = simulation.stepper, []
    state = stepper.start()
    tip = (state.position - state.position.new_tensor([0.5, 0.0, 0.0])).norm(dim=-1).argmin()
    for _ in range(round(until / 0.05)):
        state, _ = stepper.advance(state)
        tips.append(state.position[tip, 1])
    last = torch.stack(tips[2 * len(tips) // 3 :]).cpu()
    return {"amplitude": float(last.max() - last.min()), "frequency": _frequency(last, 0.05)}
