"""A cloth with a stiff half. A region of the material has another stiffness than the rest, in scene units at rest.

The stiff half keeps its length where the soft one stretches.
"""

from gaussian_swaying import Box, Material, Simulation
from gaussian_swaying.scenes import FlagScene
from gaussian_swaying.simulation.body import MaterialRegion

stiff = MaterialRegion(Box([0.6, None, None], [None, None, None]), E=1e6)
cloth = Material(E=1e4, density=30.0, regions=[stiff])
pole = Box([None, None, None], [0.06, None, None])
simulation = Simulation(FlagScene(spacing=0.05), cloth, hold=pole, wind=[6, 1, 0])
*_, frame = simulation.frames(15)
frame.save("stiff_and_soft.png")
right = simulation.start().position[:, 0] > 0  # metres from the middle of the flag
stretch = frame.state.F_total[:, :, 0].norm(dim=-1)  # along the flag
soft, hard = (float(stretch[half].mean()) - 1 for half in (~right, right))
print(f"stretched by {soft:.2%} beside the pole, by {hard:.2%} in the stiff half")
assert hard < 0.3 * soft
