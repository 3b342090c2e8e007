"""A mesh that Blender animates moves a splat. Needs `pip install bpy`.

A wave runs through a grid; the Gaussians of a flag that lies on it follow its vertices.
"""

import bpy
import torch

from gaussian_swaying import SplatSkin, export_cloud
from gaussian_swaying.scenes import FlagScene

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_grid_add(x_subdivisions=48, y_subdivisions=32, size=1)
grid = bpy.context.object
grid.location, grid.scale, grid.rotation_euler = (0.6, 0.0, 0.4), (1.2, 0.8, 1.0), (torch.pi / 2, 0, 0)
wave = grid.modifiers.new("wave", "WAVE")
wave.use_y, wave.height, wave.width, wave.narrowness, wave.speed = False, 0.1, 0.3, 5.0, 0.02


def vertices(frame):
    """Places of the vertices at a frame, in Blender's world, shape (P, 3)."""
    bpy.context.scene.frame_set(frame)
    found = grid.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return torch.tensor([tuple(found.matrix_world @ vertex.co) for vertex in found.data.vertices])


bpy.context.view_layer.update()
rest = torch.tensor([tuple(grid.matrix_world @ vertex.co) for vertex in grid.data.vertices])
faces = torch.tensor([tuple(polygon.vertices) for polygon in grid.data.polygons])
skin = SplatSkin(FlagScene(spacing=0.02, ripple=0.0).generate(), rest, faces=faces)
places = [vertices(frame) for frame in range(1, 25)]
moved, waves = [skin(place) for place in places], [place[:, 1] for place in places]
height, wanted = (max(float(y.abs().max()) for y in found) for found in ([m.means[:, 1] for m in moved], waves))
print(f"the wave is {height:.3f} m high, in Blender {wanted:.3f} m")
assert abs(height - wanted) < 0.02 * wanted
export_cloud("frame.ply", moved[-1].to_cloud())
