"""How hard it pulls. Each boundary reports the force that the body exerts on it, as the mean of a frame.

Two grommets carry a banner: together they carry its weight.
"""

from gaussian_swaying import Material, MPMSolver, OrbitCamera, PinnedPoints, Simulation
from gaussian_swaying.scenes import FlagScene

grommets = PinnedPoints([[0.02, 0.0, 0.78], [1.18, 0.0, 0.78]])  # two upper corners
solver = MPMSolver(dx=0.2, boundaries=[grommets], damping=2.0)
banner, camera = FlagScene(spacing=0.05), OrbitCamera(target_offset=[0.0, 0.0, -0.2])
simulation = Simulation(banner, Material(E=3e3, density=30.0), solver=solver, camera=camera)
*_, frame = simulation.frames(120)
frame.save("support_forces.png")
x, y, z = frame.health.support[0]
weight = 9.8 * float(simulation.solver.points.mass.sum())
print(f"{weight:.2f} N hang from the two: {z:.2f} N")
assert abs(z + weight) < 0.05 * weight
