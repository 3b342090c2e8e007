"""Two winds from one state. `start` and `advance` are the loop behind `frames`, and no state is ever changed in place.

So a state can be kept, stepped twice, or stepped in a program of your own.
"""

from gaussian_swaying import Box, Material, Simulation
from gaussian_swaying.scenes import FlagScene

pole = Box([None, None, None], [0.11, None, None])
cloth = Material(E=3e3, density=30.0)
simulation = Simulation(FlagScene(spacing=0.05), cloth, hold=pole, wind=[0, 3, 0])
state = simulation.start()
for _ in range(5):
    state, health = simulation.advance(state)
kept = state.position.clone()
ends = []
for speed in (3.0, -6.0):
    simulation.change("wind.flow", [0.0, speed, 0.0])
    end, health = simulation.advance(state)  # substeps that are stable, done again if they were too long
    ends.append(float(end.velocity[:, 1].mean()))
print(f"{ends[0]:+.2f} m/s in the same wind, {ends[1]:+.2f} m/s in one from the other side")
assert ends[1] < ends[0]
assert (state.position == kept).all()
