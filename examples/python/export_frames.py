"""The motion as splats. `frame.save` writes the Gaussians of a frame; the ending of the name chooses the format.

`gaussian-swaying export` does the same for the folder of a run, and writes USD with all frames.
"""

from pathlib import Path

from gaussian_swaying import Box, Material, Simulation, read_gaussians
from gaussian_swaying.scenes import FlagScene

folder = Path("export_frames")
folder.mkdir(exist_ok=True)
pole = Box([None, None, None], [0.06, None, None])
simulation = Simulation(FlagScene(spacing=0.05), Material(E=3e3, density=30.0), hold=pole, wind=[3, 2, 0])
for frame in simulation.frames(4):
    frame.save(folder / f"{frame.index:04d}.spz")
first, last = (read_gaussians(folder / f"{k:04d}.spz").means for k in (0, 3))
print(f"{len(last)} Gaussians, moved by {(last - first).norm(dim=-1).mean():.4f} m after three frames")
assert (last - first).norm(dim=-1).mean() > 1e-3
