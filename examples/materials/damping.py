"""How fast it comes to rest. `solver.damping` is the rate at which velocities decay, whatever the frequency.

Two sheets are let go in a bent shape; the kinetic energy of the damped one falls behind.
"""

from gaussian_swaying import Box, Material, MPMSolver, PinnedRegion, Simulation
from gaussian_swaying.scenes import FlagScene

pole, energy = PinnedRegion(Box([None, None, None], [0.11, None, None])), []
for rate in (0.0, 4.0):
    solver = MPMSolver(dx=0.2, boundaries=[pole], damping=rate)  # with gravity: it falls from its plane
    simulation = Simulation(FlagScene(spacing=0.05), Material(E=3e4, density=30.0), solver=solver)
    *_, frame = simulation.frames(12)
    frame.save(f"damping_{rate:g}.png")
    energy.append(frame.health.kinetic)
    print(f"damping {rate:g} 1/s: {frame.health.kinetic:.4f} J of motion after {frame.time:.2f} s")
assert energy[1] < 0.5 * energy[0]
