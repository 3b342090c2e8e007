"""Materials by name. Each has a stiffness, density and thickness from a table with sources; a light one flies further.

In a YAML this is ``material: silk``.
"""

from gaussian_swaying import Box, Simulation
from gaussian_swaying.mpm.materials import MATERIALS
from gaussian_swaying.scenes import FlagScene

pole, moved = Box([None, None, None], [0.11, None, None]), {}
for name in ("silk", "cotton", "denim"):
    simulation = Simulation(FlagScene(spacing=0.05), name, hold=pole, wind=[0, 3, 0])
    *_, frame = simulation.frames(8)
    frame.save(f"known_materials_{name}.png")
    moved[name] = frame.health.displacement_mean
    known = MATERIALS[name]
    print(f"{name}: {known.density * known.thickness:.2f} kg/m², moved by {moved[name]:.3f} m")
assert moved["silk"] > moved["cotton"] > moved["denim"]
