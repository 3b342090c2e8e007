"""A cloth falls onto a ball. An obstacle is a boundary of the solver with friction; it may also move along a path.

In `total` the surface itself is stopped, so nothing ends inside the ball.
"""

from gaussian_swaying import Material, MPMSolver, PinnedRegion, Simulation
from gaussian_swaying.geometry.regions import Box, Sphere
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.scenes import FlagScene

ball = Sphere([0.8, 0.0, 0.0], 0.25)  # scene units
pole = PinnedRegion(Box([None, None, None], [0.06, None, None]))
solver = MPMSolver(dx=0.1, boundaries=[pole, Obstacle(ball, friction=0.2)], damping=1.0)
simulation = Simulation(FlagScene(spacing=0.05), Material(E=1e4, density=30.0), solver=solver, wind=[3, 0, 0])
*_, frame = simulation.frames(15)
frame.save("obstacle.png")
depth = ball.radius - (frame.gaussians.means.cpu() - frame.gaussians.means.new_tensor(ball.center).cpu()).norm(dim=-1)
print(f"the deepest of {len(depth)} Gaussians is {1000 * depth.max():.1f} mm inside the ball")
assert depth.max() < 0.02
