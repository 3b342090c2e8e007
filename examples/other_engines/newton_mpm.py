"""Newton's material point method moves a splat, and the wind on the splat bends it. Needs `newton`.
A post of jelly, fixed at its foot, has flat Gaussians on its sides. The wind sets in, and blows for a second."""

import newton
import torch
import warp
from newton.solvers import SolverImplicitMPM

from gaussian_swaying import AeroForce, GaussianCloud, SplatSkin

side, height, gap, density, E = 0.12, 0.48, 0.02, 200.0, 2e4  # m, kg/m³, Pa
builder = newton.ModelBuilder(gravity=(0, 0, 0))
SolverImplicitMPM.register_custom_attributes(builder)
builder.add_particle_grid(  # the volume of a particle is that of a cube of twice its radius
    pos=warp.vec3(-2.5 * gap, -2.5 * gap, -1.5 * gap), rot=warp.quat_identity(), vel=warp.vec3(0), dim_x=6, dim_y=6,
    dim_z=26, cell_x=gap, cell_y=gap, cell_z=gap, mass=density * gap**3, radius_mean=gap / 2, jitter=0.0,
    custom_attributes={"mpm:young_modulus": E, "mpm:poisson_ratio": 0.3, "mpm:tensile_yield_ratio": 1.0},
)  # fmt: skip
model, aero = builder.finalize(device="cpu"), AeroForce(C_D=1.2, C_F=0.0, C_L=0.0)
rest = warp.to_torch(model.particle_q).clone()
warp.to_torch(model.particle_mass)[rest[:, 2] < 0] = 0.0  # the foot, which is fixed
options = SolverImplicitMPM.Config(voxel_size=2 * gap, max_iterations=100, integration_scheme="gimp")
options.carry_residual_strain = "unconverged"  # otherwise it creeps
solver, now = SolverImplicitMPM(model, options), model.state()
turn, x, z = torch.cartesian_prod(torch.arange(4) * torch.pi / 2, torch.linspace(-1, 1, 9), torch.linspace(0, 1, 33)).T
means = torch.stack([turn.cos() * x + turn.sin(), turn.sin() * x - turn.cos(), 2 * z * height / side], -1) * side / 2
quats = torch.stack([(turn / 2).cos(), 0 * turn, 0 * turn, (turn / 2).sin()], -1)
scales = torch.tensor([side / 8, 1e-3, height / 32]).log().repeat(len(x), 1)  # flat along their second axes
skin = SplatSkin(GaussianCloud(means, quats, scales, 0 * x + 4, 0.3 * torch.ones(len(x), 1, 3)), rest)
moved, wind, patches = [means], torch.tensor([0.0, 4.0, 0.0]), (skin.gaussians.normals(), skin.gaussians.areas())
for _ in range(50):
    _, F = skin.motion(warp.to_torch(now.particle_q))
    force, _ = aero.on_patches(wind, skin.velocity(warp.to_torch(now.particle_qd)), F, patches)
    warp.to_torch(now.particle_f).copy_(skin.spread(force))
    solver.step(now, now, None, None, 0.02)
    moved.append(skin(warp.to_torch(now.particle_q)).means)
swing = max(float((frame - means)[z == 1, 1].mean()) for frame in moved)
beam = aero.air_density * 1.2 * 4.0**2 * side * height**4 / (E * side**4 / 3)  # pushed on two sides
print(f"the top swings out by {swing:.3f} m, that of a slender beam by {beam:.3f} m")
assert abs(swing / beam - 1) < 0.15
