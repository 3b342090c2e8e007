"""Pictures of a sheet by Blender's path tracer, for ``tools/datasets/make_flag_dataset.py``.

``bpy`` is imported when a studio is created.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from blender_cloth import require_bpy

from gaussian_swaying._files import atomic

TRANSFERS = ("linear", "srgb")


@dataclass(frozen=True)
class View:
    """A pinhole camera.

    Attributes:
        pose: Camera to world, OpenGL axes (x right, y up, z backward) [m], shape (4, 4).
        angle_x: Horizontal field of view [radians].
        width: Width of the image [pixels].
        height: Height of the image [pixels].
    """

    pose: np.ndarray
    angle_x: float
    width: int
    height: int

    @property
    def focal(self) -> float:
        """Focal length [pixels]."""
        return float(0.5 * self.width / np.tan(0.5 * self.angle_x))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Positions of points [m] (..., 3) in the image [pixels], from the upper left corner; shape (..., 2)."""
        seen = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        return self.focal * seen[..., :2] / -seen[..., 2:] * [1, -1] + [0.5 * self.width, 0.5 * self.height]


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera to world, OpenGL axes, for a camera that is upright in z; shape (4, 4)."""
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, eye], -1)
    return pose


class Studio:
    """A sheet, lights and a camera.

    The light is set so that white cloth facing one lamp has the pixel value 1 with ``linear``, and each colour of the
    texture has its own value. The cloth scatters diffusely and equally on both sides.

    Units: ``lamps``, ``center``, ``lamp_size`` [m].
    """

    def __init__(
        self,
        faces: np.ndarray,
        uv: np.ndarray,
        texture: np.ndarray,
        lamps: np.ndarray,
        center: np.ndarray,
        lamp_size: float,
        samples: int,
        transparent: bool,
        transfer: str = "linear",
        threads: int = 0,
        ambient: float = 0.0,
    ) -> None:
        bpy = self._bpy = require_bpy()
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = self._scene = bpy.context.scene
        self._set_render(scene, samples, transparent, transfer, threads)
        self._transfer = transfer
        self._mesh = self._add_mesh("sheet", np.zeros((len(uv), 3)), faces, uv, texture, repeats=False).data
        self._mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
        for index, lamp in enumerate(lamps):
            self._add_lamp(f"lamp{index}", lamp, center, lamp_size, 1.0 - ambient)
        if ambient:
            scene.world = bpy.data.worlds.new("world")
            scene.world.use_nodes = True  # Blender 5 reads no color of a world without nodes
            scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (ambient, ambient, ambient, 1.0)
        camera = bpy.data.cameras.new("camera")
        camera.sensor_fit, camera.clip_start, camera.clip_end = "HORIZONTAL", 0.01, 1000.0
        self._camera = bpy.data.objects.new("camera", camera)
        scene.collection.objects.link(self._camera)
        scene.camera = self._camera

    @staticmethod
    def _set_render(scene: Any, samples: int, transparent: bool, transfer: str, threads: int) -> None:
        render, cycles = scene.render, scene.cycles
        render.engine = "CYCLES"
        cycles.device, cycles.samples, cycles.seed = "CPU", samples, 0
        cycles.use_adaptive_sampling = cycles.use_denoising = False
        cycles.pixel_filter_type = "BOX"  # a pixel is the mean over its square
        render.use_persistent_data = True
        render.film_transparent = transparent
        render.dither_intensity = 0.0
        render.resolution_percentage = 100
        if threads:
            render.threads_mode, render.threads = "FIXED", threads
        scene.view_settings.view_transform = "Raw" if transfer == "linear" else "Standard"
        scene.view_settings.look = "None"
        render.image_settings.file_format = "PNG"
        render.image_settings.color_mode = "RGBA" if transparent else "RGB"
        render.image_settings.color_depth = "8"

    def _add_mesh(
        self, name: str, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, texture: np.ndarray, repeats: bool
    ) -> Any:
        mesh = self._bpy.data.meshes.new(name)
        mesh.from_pydata(vertices.tolist(), [], faces.tolist())
        layer = mesh.uv_layers.new()
        layer.data.foreach_set("uv", uv[faces.reshape(-1)].astype(np.float32).reshape(-1))
        mesh.materials.append(_cloth_material(self._bpy, texture, self._transfer, repeats))
        thing = self._bpy.data.objects.new(name, mesh)
        self._scene.collection.objects.link(thing)
        return thing

    def add_room(self, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, texture: np.ndarray) -> None:
        """Add something that stands still; the shadow of the sheet falls on it, but it keeps no light off the sheet.

        Units: ``vertices`` [m].
        """
        thing = self._add_mesh("room", vertices, faces, uv, texture, repeats=True)
        thing.visible_shadow = thing.visible_diffuse = False

    def _add_lamp(self, name: str, position: np.ndarray, center: np.ndarray, size: float, share: float) -> None:
        from mathutils import Matrix

        light = self._bpy.data.lights.new(name, "AREA")
        light.shape, light.size = "SQUARE", size
        # a diffuse lamp of power P gives P / (pi d^2) at distance d; white cloth scatters 1 / pi of that
        light.energy = float(share * np.pi**2 * ((position - center) ** 2).sum())
        lamp = self._bpy.data.objects.new(name, light)
        lamp.matrix_world = Matrix(look_at(position, center).tolist())
        self._scene.collection.objects.link(lamp)

    def move(self, vertices: np.ndarray) -> None:
        """Give the sheet a shape [m], shape (V, 3)."""
        self._mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, dtype=np.float32).reshape(-1))
        self._mesh.update()

    def photograph(self, view: View, path: Path) -> None:
        """Write a PNG; it gets its name only when it is complete."""
        from mathutils import Matrix

        render = self._scene.render
        render.resolution_x, render.resolution_y = view.width, view.height
        self._camera.data.angle = view.angle_x
        self._camera.matrix_world = Matrix(view.pose.tolist())
        with atomic(path) as temporary, _quiet():
            render.filepath = str(temporary)
            self._bpy.ops.render.render(write_still=True)


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide what Blender prints for each picture, which bypasses Python's own output."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)


def _cloth_material(bpy: Any, texture: np.ndarray, transfer: str, repeats: bool) -> Any:
    height, width = texture.shape[:2]
    image = bpy.data.images.new("texture", width, height, float_buffer=False)
    image.colorspace_settings.name = "Non-Color" if transfer == "linear" else "sRGB"
    rows = np.ones((height, width, 4), dtype=np.float32)
    rows[..., :3] = texture[::-1]  # Blender's first row is the lowest
    image.pixels.foreach_set(rows.reshape(-1))
    image.pack()
    material = bpy.data.materials.new("cloth")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    picture = nodes.new("ShaderNodeTexImage")
    picture.image, picture.extension = image, "REPEAT" if repeats else "EXTEND"
    diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    links.new(picture.outputs["Color"], diffuse.inputs["Color"])
    links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    return material
