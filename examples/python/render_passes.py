"""More than colour. A run records depth, normals, the force of the wind and streaks of air beside its pictures.

Any function of the deformed Gaussians can be another pass (docs/extending.md).
"""

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from gaussian_swaying import Box, Material, OrbitCamera, Recorder, Simulation
from gaussian_swaying.scenes import FlagScene

pole, passes = Box([None, None, None], [0.06, None, None]), ["color", "depth", "normal", "force", "wind"]
simulation = Simulation(
    FlagScene(spacing=0.05), Material(E=3e3, density=30.0), hold=pole, wind=[4, 1, 0],
    camera=OrbitCamera(320, 180), recorder=Recorder(renders=passes, video=False),
)  # fmt: skip
simulation.run("render_passes", frames=6, progress=False)
rows = [iio.imread(Path("render_passes") / ("frames" if name == "color" else name) / "00005.png") for name in passes]
iio.imwrite("render_passes.png", np.concatenate([row[..., :3] for row in rows]))
print("from top to bottom:", ", ".join(passes))
assert all(row.max() > 100 for row in rows)
