"""Air that the body changes. A lattice Boltzmann flow in a box around a flag, which takes the momentum it gives.

Behind the flag the air is slower than before it. `recorder.renders: [vorticity]` draws the wake of a whole run.
"""

from gaussian_swaying import Box, Material, Simulation
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.wind.computed_air import ComputedAir

air = ComputedAir(low=[-1.2, -0.8, -0.8], high=[1.6, 0.8, 0.8], cells=24, speed=12.0)
pole = Box([None, None, None], [0.11, None, None])
cloth = Material(E=1e4, density=100.0)
simulation = Simulation(FlagScene(spacing=0.05), cloth, hold=pole, wind=[0, 4, 0], air=air)
*_, frame = simulation.frames(4)
frame.save("computed_air.png")
print(f"moved by {frame.health.displacement_mean:.4f} m in air of {simulation.stepper.air.resolution}")
assert frame.health.displacement_mean > 0
