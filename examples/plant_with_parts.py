"""A plant whose parts differ: ``python examples/plant_with_parts.py`` holds the soil, and bends stalks and leaves.

Each Gaussian has a label, and each label a role and a material. Here colours and heights make the labels; the preview
finds those of a plant in a pot by itself, and the live page has a brush for them.
"""

import sys
from pathlib import Path

import torch

from gaussian_swaying import AeroForce, Material, MPMSolver, OrbitCamera, Simulation
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.scenes import GivenScene
from gaussian_swaying.scenes.ficus import ficus
from gaussian_swaying.simulation.body import Scene


def main(folder: Path, frames: int = 50, spacing: float = 0.03, dx: float = 0.08) -> dict[str, float]:
    """Save a picture of the plant at its end, and return how far each part has moved on average [m].

    Args:
        folder: Where the picture and the labels go.
        frames: Frames of 1/25 s; the first is at rest.
        spacing: Distance between the Gaussians [m].
        dx: Cell of the grid [m].
    """
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    cloud = ficus(spacing=spacing, count=600)
    height, green = cloud.means[:, 2], torch.from_numpy(Gaussians.of(cloud).green)
    label = torch.where(green, 3, 2)  # leaves and wood
    label[(height < 0.32) & ~green] = 1  # the pot and its soil
    label[height < 0.02] = 0  # the floor
    parts = Parts(
        label,
        [
            Part("floor", "still"),  # drawn only
            Part("pot", "held"),
            Part("wood", E=4e6, density=300.0, thickness=0.02),
            Part("leaf", E=1e6, density=300.0, thickness=0.003, damping_ratio=0.1),
        ],
    )
    parts.save(folder / "parts.npz")  # what `scene.parts` of a YAML names
    simulation = Simulation(
        Scene(generator=GivenScene(cloud), parts=parts),
        wind=[1.7, 0.3, 0.0],
        aero=AeroForce(C_D=0.5, C_F=0.4, C_L=0.01),
        material=Material(),
        solver=MPMSolver(dx=dx, gravity=[0.0, 0.0, 0.0], damping=1.0),  # a capture is in balance with its weight
        camera=OrbitCamera(radius=1.6, elevation=8.0),
        background=[1.0, 1.0, 1.0],
        device="cpu",
    )
    *_, frame = simulation.frames(frames)
    iio.imwrite(folder / "plant.png", (255 * frame.render().color.clamp(0, 1)).byte().cpu().numpy())
    moved = (frame.gaussians.means - cloud.means.to(frame.gaussians.means)).norm(dim=-1)
    return {part.name: float(moved[label == number].mean()) for number, part in enumerate(parts.parts)}


if __name__ == "__main__":
    to = Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/plant_with_parts")
    found = main(to)
    print(", ".join(f"{name} {distance:.3f} m" for name, distance in found.items()), f"; see {to / 'plant.png'}")
    assert found["pot"] < 1e-3 < found["wood"] < found["leaf"]
