"""A box of sand falls apart. Plastic laws need the formulation `updated`, which follows the flow with a moving grid.

The heap spreads on the ground, which it does not pass.
"""

from gaussian_swaying import Material, MPMSolver, Scene, Simulation
from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.scenes import SolidScene

ground = Obstacle(HalfSpace([0.0, 0.0, -0.25], [0.0, 0.0, 1.0]), friction=0.5)
solver = MPMSolver(dx=0.1, formulation="updated", boundaries=[ground])
sand = Material(E=2e5, density=1600.0, volume="cell", law=Sand(friction_angle=30.0))
box = Scene(generator=SolidScene("box", size=0.5, spacing=0.05), wind_on="all")
simulation = Simulation(box, sand, solver=solver)
frames = [frame.state.position for frame in simulation.frames(8)]
widths = [(x.amax(0) - x.amin(0))[0].item() for x in (frames[0], frames[-1])]
print(f"{widths[0]:.2f} m wide, then {widths[1]:.2f} m")
assert widths[1] > widths[0]
