"""A solver of your own, of four methods. Here each point hangs on a spring; sampling, wind, pictures stay the same."""

import torch

from gaussian_swaying import Material, Simulation
from gaussian_swaying.mpm.forces import as_forces, split
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.scenes import FlagScene


class Springs(Solver):
    formulation, dx, gravity, points = "springs", 0.2, (0.0, 0.0, 0.0), None
    boundaries, settings = (), None

    def init_state(self, points, *, frame=None, surface=None):
        self.points, x = points, points.position
        F, time = torch.eye(3).expand(len(x), 3, 3), torch.zeros((), dtype=torch.float64)
        empty = {"lost": torch.zeros(len(x), dtype=torch.bool), "impulse": time.expand(0, 3)}
        return State(position=x, velocity=0 * x, F_elastic=F, F_total=F, time=time, work=time, **empty)

    def rollout(self, state, dt, steps, forces=None):
        for _ in range(steps):
            load = sum(split(force(state), force, state)[0] for force in as_forces(forces)) / self.points.mass[:, None]
            v = state.velocity + dt * (load - 100.0 * (state.position - self.points.position) - state.velocity)
            state = state.replace(position=state.position + dt * v, velocity=v, time=state.time + dt, substep=dt)
        return state

    def cells_per_second(self, state):
        return state.position.new_tensor(10.0)

    def elastic_energy(self, state):
        return 50.0 * (self.points.mass * (state.position - self.points.position).square().sum(-1)).sum(-1)


if __name__ == "__main__":
    flag = Simulation(FlagScene(spacing=0.05), Material(density=30.0), solver=Springs(), wind=[3, 2, 0])
    *_, frame = flag.frames(6)
    print(f"moved by {frame.health.displacement_mean:.3f} m")
    assert 0 < frame.health.displacement_mean < 1
