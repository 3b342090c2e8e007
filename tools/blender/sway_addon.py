"""Blender add-on: plays .sway files as point clouds, and simulates wind that is keyed in Blender (tried: bpy 5.0.1).

Its entries are in File, Import: a point cloud that follows the frames of a film, an arrow along which the wind blows,
as fast [m/s] as its property `wind` says, and a simulation with the keyed wind in the background, which loads its film.
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

bl_info = {"name": "Swaying splats", "author": "gaussian_swaying", "version": (0, 1, 0), "blender": (4, 2, 0)}
bl_info |= {"location": "File > Import", "category": "Import-Export", "description": "Gaussian splats in the wind"}
REST = [("position", "<f4", 3), ("color", "u1", 4), ("turn", "<i2", 4), ("scale", "<f2", 3), ("growth", "u1")]
KINDS = {"still": REST, "moving": [*REST, ("arm", "<f4", 3), ("stencil", "<u4"), ("facing", "<i2", 4)]}


def planes(block, kind):
    """Numbers whose first bytes stand together, then the second, and so on."""
    return np.frombuffer(block, np.uint8).reshape(np.dtype(kind).itemsize, -1).T.copy().view(np.dtype(kind))[:, 0]


def rotations(quats):
    """Matrices (N, 3, 3) of quaternions wxyz (N, 4) of any length."""
    q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    across = np.cross(np.eye(3), q[:, None, 1:])  # of its rows
    return np.eye(3) + 2 * (q[:, :1, None] * across + across @ across)


def quaternions(m):
    """Quaternions wxyz (N, 4) of rotations (N, 3, 3): an eigenvector, which is exact for half a turn, too."""
    k = np.zeros((len(m), 4, 4))
    k[:, 0, 0], twice = np.einsum("pii->p", m), m - m.transpose(0, 2, 1)
    k[:, 1:, 1:] = m + m.transpose(0, 2, 1) - np.eye(3) * k[:, :1, :1]
    k[:, 1:, 0] = twice[:, [2, 0, 1], [1, 2, 0]]
    return np.linalg.eigh(k)[1][:, :, 3]


@lru_cache(8)  # by path and time of writing
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
        found, steps, self.far = {name: [np.empty(0, kind)] for name, kind in KINDS.items()}, [], []
        for (kind, first, last), block in zip(head["parts"], blocks[2:], strict=True):
            if kind != "frames":
                found[kind].append(planes(block, KINDS[kind]))
                continue
            size, end = (width * (last - first) for width in (6 * head["nodes"], 6 * head["nodes"] + 4))
            steps.append(planes(block[:size], "<u2").reshape(last - first, -1, 3))
            counts = np.cumsum(planes(block[size:end], "<u4"))
            self.far += np.split(planes(block[end:], "<i4").reshape(-1, 4), counts[:-1])
        v, moving, still = (np.concatenate(part) for part in (steps, found["moving"], found["still"]))
        self.steps = np.cumsum(v >> 1 ^ -(v & 1), axis=0, dtype=np.uint16).view(np.int16)
        position, color, turn, scale, _ = (np.concatenate([moving[n], still[n]], dtype=float) for n, *_ in REST)
        unit, corner, cell = 1 / head["metre"], np.array(head["corner"]), head["cell"]
        self.rest, self.color = position * unit, color / 255
        self.axes = rotations(turn) * np.exp(scale)[:, None] * unit
        self.rows = planes(blocks[1], "<u4").reshape(-1, 27)[moving["stencil"]]
        place = ((moving["position"].astype(float) - corner) / cell - moving["arm"]).astype(np.float32)
        self.arm = (moving["position"] - (place * cell + corner)) * unit
        f = (place - np.floor(place - 0.5)).astype(float)
        values = np.stack([(1.5 - f) ** 2 / 2, 0.75 - (f - 1) ** 2, (f - 0.5) ** 2 / 2], -1)
        slopes = np.stack([f - 1.5, -2 * (f - 1), f - 0.5], -1) / (cell * unit)
        along = [[slopes if k == axis else values for k in range(3)] for axis in (None, 0, 1, 2)]
        self.weights = [np.einsum("pa,pb,pc->pabc", x[:, 0], y[:, 1], z[:, 2]).reshape(-1, 27) for x, y, z in along]

    def moved(self, frame):
        """Centres (N, 3) [m] and covariances (N, 3, 3) in a frame; a fraction is between two."""
        low = int(np.clip(np.floor(frame + 1e-6), 0, len(self.steps) - 1))
        share, centre, axes, at = float(np.clip(frame - low, 0, 1)), self.rest.copy(), self.axes.copy(), 0.0
        for k, part in ((low, 1 - share), (min(low + 1, len(self.steps) - 1), share)):
            nodes, far = self.steps[k] * np.float64(self.head["step"]), self.far[k]
            nodes[far[:, 0]] = far[:, 1:].copy().view(np.float32)
            at = at + part * nodes[self.rows]
        u, *slopes = (np.einsum("pk,pkd->pd", weight, at) for weight in self.weights)
        F, count = np.eye(3) + np.stack(slopes, -1), len(self.rows)
        centre[:count] += u + (F @ self.arm[..., None])[..., 0] - self.arm
        axes[:count] = F @ axes[:count]
        return centre, axes @ axes.transpose(0, 2, 1)


def show(cloud, film, frame):
    centre, shape = film.moved(frame)
    squares, axes = np.linalg.eigh(shape)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]
    sizes = np.sqrt(np.maximum(squares, 1e-20))
    columns = {"position": ("FLOAT_VECTOR", "vector", centre), "scale": ("FLOAT_VECTOR", "vector", sizes)}
    columns |= {"rotation": ("QUATERNION", "value", quaternions(axes)), "color": ("FLOAT_COLOR", "color", film.color)}
    columns |= {"radius": ("FLOAT", "value", sizes.mean(1)), "opacity": ("FLOAT", "value", film.color[:, 3])}
    for name, (kind, field, numbers) in columns.items():
        attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(field, numbers.astype(np.float32).ravel())
    cloud.update_tag()


def load(path):
    """A point cloud object that plays a .sway file from the first frame of the scene on."""
    film, mesh = Film(path), bpy.data.meshes.new(Path(path).stem)
    mesh.vertices.add(len(film.rest))
    made = bpy.data.objects.new(mesh.name, mesh)
    bpy.context.collection.objects.link(made)
    with bpy.context.temp_override(active_object=made, object=made, selected_editable_objects=[made]):
        bpy.ops.object.convert(target="POINTCLOUD")
    made.data["sway_file"], made.data["sway_start"] = str(path), bpy.context.scene.frame_start
    show(made.data, film, 0)


@persistent
def on_frame(scene, _graph=None):
    fps = scene.render.fps / scene.render.fps_base
    for cloud in bpy.data.pointclouds:
        path = Path(bpy.path.abspath(cloud.get("sway_file", "")))
        if "sway_file" in cloud and path.is_file():
            time, film = (scene.frame_current - cloud["sway_start"]) / fps, Film(path, path.stat().st_mtime)
            show(cloud, film, time / film.head["frame_dt"])


def wind_keys(scene, wind):
    """The flow [m/s] at each frame of a scene: along the arrow, as fast as its `wind` says."""
    found, now, fps = [], scene.frame_current, scene.render.fps / scene.render.fps_base
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        flow = wind.matrix_world.to_3x3().normalized().col[2] * wind["wind"]
        found.append({"time": round((frame - scene.frame_start) / fps, 6), "flow": [round(v, 5) for v in flow]})
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
        bpy.ops.object.empty_add(type="SINGLE_ARROW", rotation=(0, np.pi / 2, 0))
        context.object.name, context.object["wind"] = "wind", 4.0
        return {"FINISHED"}


class Simulate(bpy.types.Operator, ImportHelper):
    bl_idname, bl_label = "object.sway_simulate", "Simulate a swaying splat (.yaml)"
    program: bpy.props.StringProperty(name="Program", default="gaussian-swaying")

    def execute(self, context):
        scene, wind = context.scene, next((o for o in bpy.data.objects if "wind" in o and o.type == "EMPTY"), None)
        if wind is None:
            self.report({"ERROR"}, "There is no wind: add it with File, Import.")
            return {"CANCELLED"}
        out, keys = Path(self.filepath).with_suffix(""), json.dumps(wind_keys(scene, wind))
        sim = [*self.program.split(), "sim", "--config", self.filepath, "--output", str(out), "--frame_dt"]
        sim += [str(scene.render.fps_base / scene.render.fps), "--frames", str(scene.frame_end - scene.frame_start + 1)]
        sim += ["--recorder.nodes=true", "--recorder.renders=[]", "--wind.flow=null", "--wind.interpolation=linear"]
        job = subprocess.Popen([*sim, f"--wind.schedule={keys}"])

        def wait():
            done, target = job.poll(), str(out.with_suffix(".sway"))
            if done == 0 and not subprocess.call([*sim[: sim.index("sim")], "export", str(out), target]):
                load(target)
            return 1.0 if done is None else None

        bpy.app.timers.register(wait, first_interval=1.0)
        return {"FINISHED"}


def menu(self, _context):
    for kind in ("import_scene.sway", "object.sway_wind", "object.sway_simulate"):
        self.layout.operator(kind)


def register(there=True):
    for kind in (ImportSway, AddWind, Simulate):
        (bpy.utils.register_class if there else bpy.utils.unregister_class)(kind)
    for callers, own in ((bpy.types.TOPBAR_MT_file_import, menu), (bpy.app.handlers.frame_change_post, on_frame)):
        (callers.append if there else callers.remove)(own)


def unregister():
    register(there=False)
