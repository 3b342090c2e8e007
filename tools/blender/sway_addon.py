"""Blender add-on: plays .sway files as point clouds, and simulates wind that is keyed in Blender.

Install it from the file (Edit, Preferences, Add-ons). Its entries are in File, Import. "Swaying splat" makes a point
cloud whose attributes follow the frames. "Wind" makes an empty arrow, along which the wind blows, with its speed [m/s]
in the property `wind`; both can be keyed. "Simulate" runs `gaussian-swaying` with them in the background, and loads
what it made. Tried with bpy 5.0.1; the splats of Blender 5.3 could not be tried.
"""

import json
import subprocess
import zlib
from functools import lru_cache
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy_extras.io_utils import ImportHelper
from mathutils import Vector

bl_info = {
    "name": "Swaying splats", "author": "gaussian_swaying", "version": (0, 1, 0), "blender": (4, 2, 0),
    "location": "File > Import, Object > Swaying splat", "category": "Import-Export",
    "description": "Gaussian splats in the wind (.sway)",
}  # fmt: skip
KEY = "sway_file"
REST = [("position", "<f4", 3), ("color", "u1", 4), ("turn", "<i2", 4), ("scale", "<f2", 3), ("growth", "u1")]
MOVING = [*REST, ("arm", "<f4", 3), ("stencil", "<u4"), ("facing", "<i2", 4)]


def planes(block, kind):
    """Numbers whose first bytes stand together, then the second, and so on."""
    rows = np.frombuffer(block, np.uint8).reshape(np.dtype(kind).itemsize, -1)
    return np.ascontiguousarray(rows.T).view(kind)[:, 0]


def rotations(quats):
    """Matrices (N, 3, 3) of quaternions wxyz (N, 4) of any length."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, 1).reshape(-1, 3, 3)


def quaternions(m):
    """Quaternions wxyz (N, 4) of rotations (N, 3, 3): an eigenvector, which is exact for half a turn, too."""
    k = np.zeros((len(m), 4, 4))
    for i in range(3):
        k[:, i, :3] = m[:, i] + m[:, :, i]
        k[:, i, i] -= np.einsum("pii->p", m)
        k[:, 3, i] = m[:, (i + 2) % 3, (i + 1) % 3] - m[:, (i + 1) % 3, (i + 2) % 3]
    k[:, 3, 3] = np.einsum("pii->p", m)
    return np.linalg.eigh(k)[1][:, [3, 0, 1, 2], 3]


class Film:
    """A .sway file (docs/bundle.md), in metres with z up around the centre of the object."""

    def __init__(self, path, _written=0.0):
        content, at, blocks = Path(path).read_bytes(), 8, []
        if content[:8] != b"SWAY\1\0\0\0":
            raise ValueError(f"{path} is no .sway file of version 1: write one with `gaussian-swaying export`.")
        while at < len(content):
            size = int.from_bytes(content[at : at + 4], "little")
            blocks.append(zlib.decompress(content[at + 4 : at + 4 + size]))
            at += 4 + size
        self.head = head = json.loads(blocks[0])
        found, steps, self.far = {"moving": [], "still": []}, [], []
        for (kind, first, last), block in zip(head["parts"], blocks[2:], strict=True):
            if kind != "frames":
                rows = np.frombuffer(block, np.uint8).reshape(-1, last - first).T
                found[kind].append(np.ascontiguousarray(rows).view(MOVING if kind == "moving" else REST)[:, 0])
                continue
            size = 6 * head["nodes"] * (last - first)
            steps.append(planes(block[:size], "<u2").reshape(last - first, -1, 3))
            counts = planes(block[size : size + 4 * (last - first)], "<u4")
            rows = planes(block[size + 4 * (last - first) :], "<i4").reshape(-1, 4)
            self.far += np.split(rows, np.cumsum(counts)[:-1])
        v, every = np.concatenate(steps), [*found["moving"], *found["still"]]
        self.steps = np.cumsum(v >> 1 ^ -(v & 1), axis=0, dtype=np.uint16).view(np.int16)
        position, turn, scale, color = (
            np.concatenate([part[name] for part in every]).astype(float)
            for name in ("position", "turn", "scale", "color")
        )
        unit, corner, cell = 1 / head["metre"], np.array(head["corner"]), head["cell"]
        self.rest, self.color = position * unit, color / 255
        axes = rotations(turn) * np.exp(scale)[:, None] * unit
        self.shapes = axes @ axes.transpose(0, 2, 1)
        if not head["moving"]:
            return
        moving = np.concatenate(found["moving"])
        self.rows = planes(blocks[1], "<u4").reshape(-1, 27)[moving["stencil"]]
        place = ((moving["position"].astype(float) - corner) / cell - moving["arm"]).astype(np.float32)
        self.arm = (moving["position"] - (place * cell + corner)) * unit
        f = (place - np.floor(place - 0.5)).astype(float)
        values = np.stack([(1.5 - f) ** 2 / 2, 0.75 - (f - 1) ** 2, (f - 0.5) ** 2 / 2], -1)
        slopes = np.stack([f - 1.5, -2 * (f - 1), f - 0.5], -1) / (cell * unit)
        self.weights = [
            np.einsum("pa,pb,pc->pabc", *((slopes if k == along else values)[:, k] for k in range(3))).reshape(-1, 27)
            for along in (None, 0, 1, 2)
        ]

    def moved(self, frame):
        """Centres (N, 3) [m] and covariances (N, 3, 3) in a frame; a fraction is between two."""
        low = int(np.clip(np.floor(frame + 1e-6), 0, len(self.steps) - 1))
        high, share = min(low + 1, len(self.steps) - 1), float(np.clip(frame - low, 0, 1))
        nodes = (1 - share) * self._nodes(low) + share * self._nodes(high)
        centre, shape, count = self.rest.copy(), self.shapes.copy(), self.head["moving"]
        if count:
            at = nodes[self.rows]
            u, *slopes = (np.einsum("pk,pkd->pd", weight, at) for weight in self.weights)
            grown = np.stack(slopes, -1)
            centre[:count] += u + (grown @ self.arm[..., None])[..., 0]
            F = np.eye(3) + grown
            shape[:count] = F @ shape[:count] @ F.transpose(0, 2, 1)
        return centre, shape

    def _nodes(self, frame):
        nodes = self.steps[frame] * np.float64(self.head["step"])
        far = self.far[frame]
        nodes[far[:, 0]] = np.ascontiguousarray(far[:, 1:]).view(np.float32)
        return nodes


film_of = lru_cache(8)(Film)  # by path and time of writing


def show(cloud, film, frame):
    """Write the Gaussians of a frame into the attributes of a point cloud."""
    centre, shape = film.moved(frame)
    values, axes = np.linalg.eigh(shape)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]
    sizes = np.sqrt(np.maximum(values, 1e-20))
    columns = {
        "position": ("FLOAT_VECTOR", "vector", centre), "radius": ("FLOAT", "value", sizes.mean(1)),
        "scale": ("FLOAT_VECTOR", "vector", sizes), "rotation": ("QUATERNION", "value", quaternions(axes)),
        "color": ("FLOAT_COLOR", "color", film.color), "opacity": ("FLOAT", "value", film.color[:, 3]),
    }  # fmt: skip
    for name, (kind, field, numbers) in columns.items():
        attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(field, np.ascontiguousarray(numbers, np.float32).ravel())
    cloud.update_tag()


def load(path):
    """A point cloud object that plays a .sway file from the first frame of the scene on."""
    film, mesh = Film(path), bpy.data.meshes.new(Path(path).stem)
    mesh.vertices.add(film.head["count"])
    made = bpy.data.objects.new(mesh.name, mesh)
    bpy.context.collection.objects.link(made)
    with bpy.context.temp_override(
        active_object=made, object=made, selected_objects=[made], selected_editable_objects=[made]
    ):
        bpy.ops.object.convert(target="POINTCLOUD")
    made.data[KEY], made.data["sway_start"] = str(path), bpy.context.scene.frame_start
    show(made.data, film, 0)


@persistent
def on_frame(scene, _graph=None):
    fps = scene.render.fps / scene.render.fps_base
    for cloud in bpy.data.pointclouds:
        path = Path(bpy.path.abspath(cloud.get(KEY, "")))
        if KEY in cloud and path.is_file():
            film = film_of(path, path.stat().st_mtime)
            show(cloud, film, (scene.frame_current - cloud["sway_start"]) / fps / film.head["frame_dt"])


def wind_keys(scene, wind):
    """The flow [m/s] at each frame of a scene: along the arrow, as fast as its `wind` says."""
    found, now = [], scene.frame_current
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        flow = wind.matrix_world.to_3x3().normalized() @ Vector((0, 0, wind["wind"]))
        time = (frame - scene.frame_start) * scene.render.fps_base / scene.render.fps
        found.append({"time": round(time, 6), "flow": [round(v, 5) for v in flow]})
    scene.frame_set(now)
    return found


class ImportSway(bpy.types.Operator, ImportHelper):
    bl_idname, bl_label, filename_ext = "import_scene.sway", "Swaying splat (.sway)", ".sway"
    filter_glob: bpy.props.StringProperty(default="*.sway", options={"HIDDEN"})

    def execute(self, _context):
        load(self.filepath)
        return {"FINISHED"}


class AddWind(bpy.types.Operator):
    bl_idname, bl_label = "object.sway_wind", "Wind for a swaying splat"

    def execute(self, context):
        wind = bpy.data.objects.new("wind", None)
        wind.empty_display_type, wind["wind"] = "SINGLE_ARROW", 4.0
        wind.rotation_euler = (0, np.pi / 2, 0)
        context.collection.objects.link(wind)
        return {"FINISHED"}


class Simulate(bpy.types.Operator, ImportHelper):
    bl_idname, bl_label = "object.sway_simulate", "Simulate a swaying splat (.yaml)"
    program: bpy.props.StringProperty(name="Program", default="gaussian-swaying")

    def execute(self, context):
        scene, wind = context.scene, next((o for o in bpy.data.objects if "wind" in o and o.type == "EMPTY"), None)
        if wind is None:
            self.report({"ERROR"}, "There is no wind: add it with File, Import.")
            return {"CANCELLED"}
        out, step = Path(self.filepath).with_suffix(""), scene.render.fps_base / scene.render.fps
        keys = "--wind.schedule=" + json.dumps(wind_keys(scene, wind))
        sim = [*self.program.split(), "sim", "--config", self.filepath, "--output", str(out), "--frame_dt", str(step)]
        sim += ["--frames", str(scene.frame_end - scene.frame_start + 1), "--recorder.nodes", "true"]
        sim += ["--recorder.renders=[]", "--wind.flow=null", "--wind.interpolation=linear", keys]
        job = subprocess.Popen(sim)

        def wait():
            if job.poll() is None:
                return 1.0
            target = str(out.with_suffix(".sway"))
            if job.returncode == 0 and not subprocess.call([*sim[: sim.index("sim")], "export", str(out), target]):
                load(target)
            return None

        bpy.app.timers.register(wait, first_interval=1.0)
        return {"FINISHED"}


def menu(self, _context):
    for kind in CLASSES:
        self.layout.operator(kind.bl_idname)


CLASSES = ImportSway, AddWind, Simulate


def register():
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.TOPBAR_MT_file_import.append(menu)
    bpy.app.handlers.frame_change_post.append(on_frame)


def unregister():
    bpy.app.handlers.frame_change_post.remove(on_frame)
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    for kind in CLASSES:
        bpy.utils.unregister_class(kind)
