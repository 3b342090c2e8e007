"""A page that simulates. The package's kernels are inside it as WebAssembly, and its reader turns the wind.

The one file needs no server and asks the network for nothing.
"""

from pathlib import Path

from gaussian_swaying import Box, Material, MPMSolver, OrbitCamera, PinnedRegion, Simulation
from gaussian_swaying.player.live_web.page import write_live_web
from gaussian_swaying.scenes import FlagScene

pole = PinnedRegion(Box([None, None, None], [0.12, None, None]))
solver = MPMSolver(dx=0.13, boundaries=[pole])
simulation = Simulation(
    FlagScene(spacing=0.06), Material(E=5e3, density=30.0), solver=solver, wind=[5, 1, 0], device="cpu",
    camera=OrbitCamera(), background=[0.55, 0.68, 0.80],
)  # fmt: skip
page = Path("live_page.html")
write_live_web(simulation, "flag", page)
print(f"{page} has {page.stat().st_size / 1e6:.1f} MB; open it in a browser")
text = page.read_text(encoding="utf-8")
assert text.startswith("<!doctype html>")
assert "http://" not in text.split("<script")[0]
