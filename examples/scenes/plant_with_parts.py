"""A plant whose parts differ. Each Gaussian has a label, and each label a role and a material; here colours and heights
make the labels. The preview finds those of a plant in a pot by itself, and the live page has a brush for them.
"""

import torch

from gaussian_swaying import MPMSolver, OrbitCamera, Scene, Simulation
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.scenes import GivenScene
from gaussian_swaying.scenes.ficus import ficus

cloud = ficus(spacing=0.06, count=600)
height, green = cloud.means[:, 2], torch.from_numpy(Gaussians.of(cloud).green)
label = torch.where(green, 3, 2)  # leaves and wood
label[(height < 0.32) & ~green] = 1  # the pot and its soil
label[height < 0.02] = 0  # the floor
wood = Part("wood", E=4e6, density=300.0, thickness=0.02)
leaf = Part("leaf", E=1e6, density=300.0, thickness=0.003, damping_ratio=0.1)
parts = Parts(label, [Part("floor", "still"), Part("pot", "held"), wood, leaf])
parts.save("parts.npz")  # what `scene.parts` of a YAML names
simulation = Simulation(
    Scene(generator=GivenScene(cloud), parts=parts),
    wind=[1.7, 0.3, 0.0],
    solver=MPMSolver(dx=0.12, gravity=[0.0, 0.0, 0.0], damping=1.0),  # a capture is in balance with its weight
    camera=OrbitCamera(radius=1.6, elevation=8.0),
    background=[1.0, 1.0, 1.0],
)
*_, frame = simulation.frames(12)
frame.save("plant_with_parts.png")
moved = (frame.gaussians.means.cpu() - cloud.means).norm(dim=-1)
found = [float(moved[label == number].mean()) for number in range(4)]
print(", ".join(f"{part.name} {distance:.4f} m" for part, distance in zip(parts.parts, found, strict=True)))
assert found[0] == 0
assert found[1] < 1e-5 < found[2] < found[3]
