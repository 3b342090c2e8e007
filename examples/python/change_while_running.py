"""Numbers that change in motion. `change` sets the wind, the material or the damping between two frames, by name.

A live page, fits and sweeps use the same names.
"""

from gaussian_swaying import Box, Material, Simulation
from gaussian_swaying.scenes import FlagScene

pole = Box([None, None, None], [0.11, None, None])
cloth = Material(E=3e3, density=30.0)
simulation = Simulation(FlagScene(spacing=0.05), cloth, hold=pole, wind=[0, 3, 0])
print("may change:", ", ".join(simulation.model.numbers("")))
speeds = []
for frame in simulation.frames(12):
    speeds.append(float(frame.state.velocity[:, 1].mean()))
    if frame.index == 5:
        simulation.change({"wind.speed": 8.0, "material.E": 3e4})
frame.save("change_while_running.png")
print(f"{speeds[5]:.2f} m/s, then up to {max(speeds):.2f} m/s")
assert max(speeds[6:]) > 1.5 * speeds[5]
