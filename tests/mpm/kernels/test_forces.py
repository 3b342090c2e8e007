import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import in_both

from gaussian_swaying import Force, PinnedRegion, WindField
from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm import run as substeps
from gaussian_swaying.mpm import updated
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers
from gaussian_swaying.mpm.pull import pull

from .bodies import (
    DT,
    FORMULATIONS,
    LEFT,
    TOLERANCE,
    check_agreement,
    make_load,
    make_points,
    make_solver,
    noise,
    on_each,
    run_both,
    set_going,
)


@in_both
def test_forces_and_drag_of_step(kernel_device, formulation):
    points = make_points(kernel_device)
    force = (0.3 * noise(8, *points.position.shape)).to(kernel_device)
    drag = (0.5 * noise(9, *points.mass.shape).abs()).to(kernel_device)

    def run(solver, state):
        states = [solver.step(state, DT, drag=drag)]
        for factor, resistance in ((1, None), (2, drag)):
            states.append(solver.step(states[-1], DT, force=factor * force, drag=resistance))
        return states

    ends = run_both(points, run, formulation)
    check_agreement(ends)
    assert float(ends[1][2].work.abs()) > float(ends[1][0].work.abs()) == 0.0


class _Pull(Force):
    """Pulls particles to a moving place, more strongly if they are sheared; with a resistance if requested."""

    recordable = True

    def __init__(self, device, resistance=None):
        super().__init__()
        self.register_buffer("place", torch.tensor([0.3, 0.1, -0.2], device=device))
        self.register_buffer("way", torch.tensor([80.0, 0.0, 0.0], device=device))
        self.resistance, self._called = resistance, 0

    def forward(self, state):
        self._called += 1
        shear = 1 + state.F_total[..., 0, 1:2].abs() + 1e-3 * state.affine[..., 1, 2:3].abs()
        pull = 5.0 * shear * (self.place + self.way * state.time - state.position) - 0.1 * state.velocity
        if state.internal is not None:
            pull = pull + state.internal[..., None]
        if self.resistance is None:
            return pull
        return pull, self.resistance * (1 + state.velocity.square().sum(-1))


FORCES = {
    "custom": lambda points, pull: [pull],
    "wind and custom": lambda points, pull: [make_load(points), pull],
    "custom, wind, wind": lambda points, pull: [
        pull,
        make_load(points),
        make_load(points, WindField([0.0, 9.0, 0.0]), seed=14),
    ],
    "semi-implicit wind and custom": lambda points, pull: [make_load(points, drag_step="semi_implicit"), pull],
}


@pytest.mark.slow(
    gate=[f"{one}-cpu-('wind and custom', 2.0)" for one in FORMULATIONS]
    + [f"{one}-cpu-('custom, wind, wind', None)" for one in FORMULATIONS]
)
@pytest.mark.parametrize(
    ("kernel_device", "case"),
    on_each(
        ("wind and custom", 2.0),
        ("custom, wind, wind", None),
        cpu=[("custom", 2.0), ("semi-implicit wind and custom", None)],
    ),
    indirect=["kernel_device"],
    ids=str,
)
@in_both
def test_forces_in_torch_among_the_kernels(kernel_device, formulation, case, monkeypatch):
    """Across the end of a part, with particles sorted again, boundaries, and with a batch; all forces and their work.

    The time passed to forces and boundaries advances once per substep; the internal variable is passed too.
    """
    name, resistance = case
    plane = Wall(HalfSpace([0.0, 0.0, 0.13], [0.1, 0.0, 1.0]), "separate")
    held = {"boundaries": [PinnedRegion(LEFT, start=1.5 * DT), plane]}
    monkeypatch.setattr(substeps, "MAX_STEPS", 3)
    monkeypatch.setattr(updated, "sorted_for", lambda *known: 2)
    law = ELASTIC["corotated"] if formulation == "total" else PLASTIC["sand that swells"]
    points = make_points(kernel_device, law, count=6, batch=(2,))
    pull = _Pull(kernel_device, resistance)
    seen = []

    def run(solver, state):
        monkeypatch.setattr(solver, "_one_by_one", None if solver.transfer == "kernels" else solver._one_by_one)
        forces = FORCES[name](points, pull)
        states = [solver.rollout(state, DT, 1, forces)]
        state, cells = solver.watched_rollout(states[-1], 0.7 * DT, 4, forces, 2)
        seen.append(float(cells))
        return [*states, state]

    ends = run_both(points, run, formulation, **held)
    check_agreement(ends)
    assert seen[1] == pytest.approx(seen[0], rel=2 * TOLERANCE)
    free = make_solver("torch", formulation, **held)
    with torch.no_grad():
        calm = free.rollout(set_going(free, points), DT, 1, FORCES[name](points, pull)[:-1])
    assert not torch.allclose(calm.velocity, ends[0][0].velocity, rtol=1e-3)


@pytest.mark.parametrize("kernel_device", ["cpu"], indirect=True)
@in_both
def test_a_force_that_cannot_be_recorded_is_asked_by_the_host(kernel_device, formulation):
    points = make_points(kernel_device, count=12)

    class Waiting(_Pull):
        def forward(self, state):
            return super().forward(state) if float(state.time) > 0.5 * DT else 0 * state.position

    def run(solver, state):
        waiting = Waiting(kernel_device)
        end = solver.rollout(state, DT, 3, [make_load(points), waiting])
        assert waiting._called == 2
        return end

    check_agreement(run_both(points, run, formulation))


@triton.jit
def _toward(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    scale = point[0] * numbers[0] * F[0] * tl.load(table + 1)
    resistance = point[0] * 0
    if OPTIONS[0]:
        resistance = point[1]
    force = (
        scale * now[0] - resistance * velocity[0],
        scale * now[1] - resistance * velocity[1],
        scale * now[2] - resistance * velocity[2],
    )
    return force, resistance


class _Toward(Force):
    """A force outside the package with a device function."""

    def __init__(self, points, resists):
        super().__init__()
        self.resists = resists
        self.register_buffer("share", torch.stack([points.mass, 3 * points.mass], dim=-1))

    def along(self, time):
        return torch.stack([300 * time + 9, -5 + 0 * time, 1 + 2000 * time], dim=-1)

    def device_function(self):
        return DeviceFunction(
            _toward,
            options=(self.resists,),
            implicit=self.resists,
            sources=(self.share,),
            per_point=Numbers(2, lambda: self.share),
            numbers=Numbers(1, lambda: torch.tensor([1.25], device=self.share.device)),
            table=Numbers(2, lambda: [1.0, 2.0]),
            per_substep=Numbers(
                3,
                lambda time, dt, steps: self.along(
                    time + dt * torch.arange(steps, dtype=torch.float64, device=time.device)
                ),
            ),
        )


@pytest.mark.slow(gate=["cpu-total-False", "cpu-updated-True"])
@pytest.mark.parametrize("resists", [False, True])
@in_both
def test_a_twin_from_outside(kernel_device, formulation, resists):
    points = make_points(kernel_device, count=12)
    own = _Toward(points, resists)

    def run(solver, state):
        states = [solver.rollout(state, DT, 2, own)]
        for forces in ([own, make_load(points)], [make_load(points, seed=8), own, own]):
            states.append(solver.rollout(states[-1], DT, 2, forces))
        states.append(solver.rollout(states[-1], DT, 2, make_load(points)))
        own.share *= 2
        states.append(solver.rollout(states[-1], DT, 1, own))
        own.share /= 2
        return states

    check_agreement(run_both(points, run, formulation))


class _Held(Force):
    """A pull towards the place of the points at rest, as a user's mouse: more numbers of each point, but no other."""

    def __init__(self, points):
        super().__init__()
        self.register_buffer("points", torch.cat([points.position, 0.1 * points.mass[..., None]], dim=-1))

    def device_function(self):
        return pull(lambda: self.points, lambda time, dt, steps: time.float().expand(steps, 3), sources=(self.points,))


@in_both
def test_no_recording_reads_the_numbers_of_points_of_before_a_force_with_more(kernel_device, formulation):
    points = make_points(kernel_device, count=60)
    load, held = make_load(points), _Held(points)
    solver = make_solver("kernels", formulation)
    start = set_going(solver, points)
    for _ in range(3):
        solver.rollout(start, DT, 22, load)
    solver.rollout(start, DT, 22, [load, held])
    load.area.mul_(2.0)
    found = solver.rollout(start, DT, 22, load)
    fresh = make_solver("kernels", formulation)
    set_going(fresh, points)
    check_agreement([fresh.rollout(start, DT, 22, load), found])


@pytest.mark.gpu
@in_both
def test_forces_in_torch_are_replayed_from_graphs(formulation):
    pytest.importorskip("triton")
    points = make_points(torch.device("cuda"), count=60)
    pulls = [_Pull("cuda", 1.0) for _ in range(2)]
    solvers = [make_solver(transfer, formulation) for transfer in ("torch", "kernels")]
    state = set_going(solvers[0], points, strain=0.02)
    set_going(solvers[1], points)
    load = make_load(points)
    called = []
    for k in range(7):
        if k == 4:
            for pull in pulls:
                pull.place += 0.2
        if k == 5:
            for pull in pulls:
                pull.resistance = 3.0
        before = pulls[1]._called
        dt = [1e-4, 7e-5][k % 2]
        expected, found = (
            solver.rollout(state, dt, 22, [load, pull]) for solver, pull in zip(solvers, pulls, strict=True)
        )
        check_agreement([expected, found], tolerance=5e-4)
        called.append(pulls[1]._called - before)
        state = expected
    once = 1 if formulation == "updated" else 0  # at the start, where the particles are sorted
    assert called[0] > 22 - 1
    assert called[2] == called[3] == called[4] == once
    assert called[5] > 22 - 1
    assert any(solvers[1].kernels.repeater._graphs.values())
