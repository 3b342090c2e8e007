"""A live page in ten lines: ``python examples/live_page.py`` writes a file in which its reader turns the wind."""

from pathlib import Path

from gaussian_swaying import Box, Material, MPMSolver, OrbitCamera, PinnedRegion, Simulation
from gaussian_swaying.player.live_web.page import write_live_web
from gaussian_swaying.scenes import FlagScene


def main(target: Path, spacing: float = 0.03) -> int:
    """Write the page, and return its size in bytes."""
    pole = Box(min=[None, None, None], max=[2 * spacing, None, None])
    flag = FlagScene(spacing=spacing)
    solver = MPMSolver(dx=2.2 * spacing, boundaries=[PinnedRegion(pole)])
    simulation = Simulation(
        flag, Material(E=5e3, density=30.0), solver=solver, wind=[5, 1, 0], camera=OrbitCamera(), device="cpu"
    )
    write_live_web(simulation, "flag", target)
    return target.stat().st_size


if __name__ == "__main__":
    to = Path("outputs/live_flag.html")
    to.parent.mkdir(parents=True, exist_ok=True)
    print(f"{to}: {main(to) / 1e6:.1f} MB; open it in a browser")
