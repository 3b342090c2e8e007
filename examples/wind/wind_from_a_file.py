"""A measured wind. `schedule` reads the CSV of an anemometer: times, and speed with direction or three components.

Other units than those in the head of a column are an error.
"""

from pathlib import Path

import torch

from gaussian_swaying import Box, Material, Simulation, WindField
from gaussian_swaying.scenes import FlagScene

rows = ["time [s],speed [m/s],direction [deg]", "0,2,270", "0.3,6,270", "0.6,3,250"]  # from where it blows, +y is 0
Path("anemometer.csv").write_text("\n".join(rows) + "\n")
wind = WindField(flow=None, schedule="anemometer.csv")
speeds = [float(wind(torch.tensor(time, dtype=torch.float64)).norm()) for time in (0.0, 0.15, 0.3)]
pole = Box([None, None, None], [0.11, None, None])
simulation = Simulation(FlagScene(spacing=0.05), Material(E=3e3, density=30.0), hold=pole, wind=wind)
*_, frame = simulation.frames(10)
frame.save("wind_from_a_file.png")
print("speeds", *(f"{speed:.1f}" for speed in speeds), f"m/s; moved by {frame.health.displacement_mean:.3f} m")
assert max(abs(a - b) for a, b in zip(speeds, (2, 4, 6), strict=True)) < 0.1
