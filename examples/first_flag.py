"""A first flag: ``python examples/first_flag.py`` makes a splat in code, simulates three seconds and saves pictures."""

import sys
from pathlib import Path

from gaussian_swaying import (
    AeroForce,
    Box,
    DiffuseShader,
    GaussianGust,
    Material,
    OrbitCamera,
    Simulation,
    SineSway,
    WindField,
)
from gaussian_swaying.scenes import FlagScene


def main(folder: Path, frames: int = 76, spacing: float = 0.02, device: str = "auto") -> float:
    """Save a picture of each half second, and return how far the Gaussians have moved on average [m].

    Args:
        folder: Where the pictures go.
        frames: Frames of 1/25 s; the first is at rest.
        spacing: Distance between the Gaussians of the flag [m].
        device: As of ``Simulation``.
    """
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    pole = Box(min=[None, None, None], max=[0.06, None, None])  # what lies to the left of x = 0.06 does not move
    simulation = Simulation(
        FlagScene(spacing=spacing),  # or the path of a splat
        hold=pole,
        wind=WindField([6.0, 1.5, 0.0], modulations=[SineSway(0.5, period=1.5), GaussianGust(0.3)]),  # m/s
        aero=AeroForce(C_D=0.1, C_F=0.3, C_L=0.005),  # the paper's
        material=Material(E=3e3, density=30.0),
        camera=OrbitCamera(),
        shader=DiffuseShader([0.3, -1.0, 0.6], two_sided=True, ambient=0.3),
        background=[1.0, 1.0, 1.0],
        device=device,
    )
    for frame in simulation.frames(frames):
        if frame.index % 12 == 0:
            picture = (255 * frame.render().color.clamp(0, 1)).byte().cpu().numpy()
            iio.imwrite(folder / f"{frame.index:04d}.png", picture)
    return frame.health.displacement_mean


if __name__ == "__main__":
    to = Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/first_flag")
    print(f"{main(to):.2f} m on average; the pictures are in {to}")
