"""A first flag. A splat made in code flies in gusts for a second."""

from gaussian_swaying import AeroForce, Box, DiffuseShader, GaussianGust, Material, Simulation, SineSway, WindField
from gaussian_swaying.scenes import FlagScene

flag = FlagScene(spacing=0.04)  # or the path of a splat
pole = Box(min=[None, None, None], max=[0.06, None, None])  # what lies to the left of x = 0.06 does not move
simulation = Simulation(
    flag,
    hold=pole,
    wind=WindField([6.0, 1.5, 0.0], modulations=[SineSway(0.5, period=1.5), GaussianGust(0.3)]),  # m/s
    aero=AeroForce(C_D=0.1, C_F=0.3, C_L=0.005),  # the paper's
    material=Material(E=3e3, density=30.0),
    shader=DiffuseShader([0.3, -1.0, 0.6], two_sided=True, ambient=0.3),
    background=[1.0, 1.0, 1.0],
)
for frame in simulation.frames(26):
    if frame.index % 12 == 0:
        frame.save(f"first_flag_{frame.index:02d}.png")
print(f"{frame.health.displacement_mean:.2f} m on average after {frame.time:.1f} s")
assert 0.01 < frame.health.displacement_mean < 1
