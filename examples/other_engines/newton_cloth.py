"""Newton's cloth moves a splat, and the wind on the splat moves the cloth. Needs `newton`.
The flag of this package's own solver flies beside it for a third of a second.
"""

import newton
import torch
import warp

from gaussian_swaying import AeroForce, Box, Material, Simulation, SplatSkin
from gaussian_swaying.scenes import FlagScene

E, nu, thickness, density, cell, fps, substeps = 2.5e4, 0.3, 0.01, 30.0, 0.025, 25, 40
wind, aero = torch.tensor([6.0, 1.5, 0.0]), AeroForce(C_D=0.1, C_F=0.3, C_L=0.0, law="projected")
flag = FlagScene(spacing=cell, ripple=0.0)  # in the plane of x and z
builder = newton.ModelBuilder(gravity=(0, 0, 0))
along_x, origin = warp.quat_from_axis_angle(warp.vec3(1, 0, 0), warp.pi / 2), warp.vec3(cell / 2, 0, cell / 2)
builder.add_cloth_grid(  # a particle for each Gaussian, and plane stress
    pos=origin, rot=along_x, vel=warp.vec3(0), dim_x=47, dim_y=31, cell_x=cell, cell_y=cell, fix_left=True,
    mass=density * thickness * cell**2, tri_ke=E * thickness / (2 + 2 * nu), edge_ke=0.0,
    tri_ka=E * thickness * nu / (1 - nu**2), tri_kd=0.0, edge_kd=0.0,
)  # fmt: skip
builder.color()
model = builder.finalize(device="cpu")
solver, now, after = newton.solvers.SolverVBD(model, iterations=10), model.state(), model.state()
rest = warp.to_torch(now.particle_q).clone()
skin = SplatSkin(flag.generate(), rest, faces=torch.from_numpy(model.tri_indices.numpy()))
patches = skin.gaussians.normals(), skin.gaussians.areas()
material = Material(E=E, nu=nu, thickness=thickness, density=density)
ours = Simulation(flag, hold=Box([None] * 3, [0.02, None, None]), wind=wind, aero=aero, material=material, device="cpu")
for frame in ours.frames(9):
    own, moved = frame.gaussians.means, skin(warp.to_torch(now.particle_q)).means
    for _ in range(substeps):
        _, F = skin.motion(warp.to_torch(now.particle_q))
        force, _ = aero.on_patches(wind, skin.velocity(warp.to_torch(now.particle_qd)), F, patches)
        warp.to_torch(now.particle_f).copy_(skin.spread(force))
        solver.step(now, after, model.control(), None, 1 / fps / substeps)
        now, after = after, now
motion, apart = ((other - own).norm(dim=-1).mean() for other in (skin.gaussians.means, moved))
print(f"{motion:.3f} m on average, {apart / motion:.1%} apart")
assert apart < 0.1 * motion
