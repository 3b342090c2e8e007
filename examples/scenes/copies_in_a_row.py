"""A row of flags from one. Copies are simulated together, each turned, in gusts that come to the last one later.

Their states are the first dimension of the tensors.
"""

from gaussian_swaying import Box, Copy, Material, Simulation, SineSway, WindField
from gaussian_swaying.scenes import FlagScene

pole, cloth = Box([None, None, None], [0.11, None, None]), Material(E=3e3, density=30.0)
copies = [Copy(), Copy([0, 2, 0], turn=90), Copy([0, 4, 0], delay=0.3)]
wind = WindField([4.0, 1.0, 0.0], modulations=[SineSway(0.5, period=1.0)])
simulation = Simulation(FlagScene(spacing=0.05), cloth, hold=pole, wind=wind, copies=copies)
*_, frame = simulation.frames(8)
frame.save("copies_in_a_row.png")
start = simulation.start().position
moved = (frame.state.position - start).norm(dim=-1).mean(-1)
print("moved by", *(f"{x:.3f} m" for x in moved))
assert frame.state.position.shape[0] == 3
assert abs(moved[2] - moved[0]) > 1e-3
