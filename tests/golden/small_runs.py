"""Small runs whose frames are kept: every shipped configuration, and what no shipped one reaches.

They know public names of the package only.
"""

import json
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from shared import rand, seeded

from gaussian_swaying import Force, GaussianCloud, Simulation, write_ply
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.rendering.torch_renderer import TorchRenderer
from gaussian_swaying.scenes import FlagScene

CONFIGS = Path(__file__).parents[2] / "configs"
SPACING, SPARSE = "scene.generator.init_args.spacing", "scene.generator.init_args.count"
FLAG = {SPACING: 0.06, "solver.dx": 0.14}
CLOTH = {
    "scene.generator": {"class_path": "FlagScene", "init_args": {"overlap": 0.6, "stand": "none"}},
    "scene.region": {"class_path": "Box", "init_args": {"min": [None] * 3, "max": [None] * 3}},
    "contact": None,
    "material.E": 5e4,
    "camera.init_args.elevation": 8.0,
    "camera.init_args.radius": 1.9,
    "camera.init_args.target_offset": [0.0, 0.0, 0.0],
}
"""The flag without its pole, and without contact."""
ALONE = CLOTH | FLAG
# seen from above: along the normal of a flat flag all its Gaussians are at one depth, in any order
BENCH = {SPACING: 0.06, "scene.particle_spacing": 0.07, "solver.dx": 0.15, "camera.init_args.elevation": 20.0}
SOLID = {SPACING: 0.1, "solver.dx": 0.2, "material.E": 2e4}


class Swirl(Force):
    """A force of a user's own, in torch."""

    def forward(self, state):
        x = state.position
        return 2e-3 * torch.stack([-x[..., 2], torch.sin(3 * x[..., 0]) + state.velocity[..., 1], x[..., 0]], -1)


def captured(folder):
    """The file of a capture: a pot on a string, y down, in units of its own, uneven, with faint and loose Gaussians."""
    draw = seeded(0)

    def random(*shape):
        return rand(*shape, generator=draw)

    angle, height = 6.2832 * random(900), random(900)
    wide = torch.where(height < 0.6, 1.0, 0.15)
    pot = torch.stack([wide * angle.cos(), 1.0 - 6 * height, wide * angle.sin()], -1) + 0.05 * random(900, 3)
    half = torch.stack([torch.cos(angle / 2), 0 * angle, -torch.sin(angle / 2), 0 * angle], -1)
    cloud = GaussianCloud(
        means=torch.cat([pot, torch.tensor([2.0, 1.0, 0.0]) + 0.1 * random(20, 3)]).float(),
        quats=torch.cat([half, random(20, 4) - 0.5]).float(),
        scales=(torch.tensor([0.02, 0.12, 0.12]) * (0.7 + 0.6 * random(920, 3))).log().float(),
        opacities=(6 * random(920) - 2).float(),
        sh=(0.8 * (random(920, 4, 3) - 0.5)).float(),
    )
    write_ply(folder / "pot.ply", cloud)
    return {"scene.ply": str(folder / "pot.ply"), "solver.dx": 0.1}


def labelled(*parts, **more):
    def settings(folder):
        x = FlagScene(spacing=0.05).generate().means[:, 0].contiguous()
        Parts(torch.bucketize(x, torch.tensor([0.16, 0.46, 0.76])), parts).save(folder / "parts.npz")
        return (
            CLOTH
            | {
                SPACING: 0.05,
                "solver.dx": 0.12,
                "solver.boundaries": [],
                "scene.parts": str(folder / "parts.npz"),
            }
            | more
        )

    return settings


def named(class_path, **init_args):
    return {"class_path": class_path, "init_args": init_args}


def box(low, high):
    return named("Box", min=[low, None, None], max=[high, None, None])


WALL = named("HalfSpace", point=[0.0, 0.05, 0.0], normal=[0.0, -1.0, 0.0])
HELD = Part("pole", "held")
SOFT = {"E": 2e4, "nu": 0.3, "density": 40.0, "thickness": 0.01}
SMALLER = {
    "ball_on_cloth": {SPACING: 0.041, "solver.dx": 0.1, "contact.thickness": 0.03},
    "cloth_over_ball": {SPACING: 0.041, "solver.dx": 0.1, "contact.thickness": 0.03},
    "cloth_over_table": {SPACING: 0.041, "solver.dx": 0.1, "contact.thickness": 0.03},
    "two_flags": {SPACING: 0.039, "solver.dx": 0.1, "contact.thickness": 0.03},
    "sand": {SPACING: 0.11, "solver.dx": 0.11, "material.E": 2e4},
    "plant_row": {SPACING: 0.05, "solver.dx": 0.13},
    "ficus_behind_wall": {SPACING: 0.1, SPARSE: 200, "solver.dx": 0.2},
    "alocasia": {SPACING: 0.05, "solver.dx": 0.11},
    "flag1": {SPACING: 0.04, "solver.dx": 0.09},
    "flag2": {SPACING: 0.04, "solver.dx": 0.09},
    "leaves": {SPACING: 0.024, "solver.dx": 0.07},
    "telephone": {SPACING: 0.02, "solver.dx": 0.06},
}
# name: configurations, then settings or a function of a folder that makes them
CASES = {
    # shipped scenes, with their presets where they have one
    **{
        name: ([f"sim/{name}", f"sim/preview/{name}"], SMALLER.get(name, {}))
        for name in sorted(path.stem for path in CONFIGS.glob("sim/preview/*"))
    },
    "flag": (["sim/flag"], FLAG),
    "flag_in_air": (["sim/flag_in_air"], FLAG | {"air.cells": 24}),
    "hanging_object": (["sim/hanging_object"], captured),
    "printed_flag": (["sim/printed_flag"], {SPACING: 0.05, "solver.dx": 0.12}),
    "row_of_alocasias": (["sim/row_of_alocasias"], {SPACING: 0.04, "solver.dx": 0.13}),
    "solid_surface_wind": (["sim/solid_surface_wind"], SOLID),
    "solid_all_wind": (["sim/solid_surface_wind", "sim/variants/solid_all_wind"], SOLID),
    "alocasia_apart": (["sim/alocasia", "sim/variants/alocasia_apart"], {SPACING: 0.03, "solver.dx": 0.1}),
    "ficus_apart": (["sim/ficus", "sim/variants/ficus_apart"], {SPACING: 0.07, SPARSE: 300, "solver.dx": 0.16}),
    "leaves_apart": (["sim/leaves", "sim/variants/leaves_apart"], {SPACING: 0.03, SPARSE: 40, "solver.dx": 0.08}),
    "leaves_contact": (["sim/leaves", "sim/variants/leaves_contact"], {SPACING: 0.03, SPARSE: 40, "solver.dx": 0.062}),
    "flag1_pole": (["sim/flag1", "sim/variants/flag1_pole"], {SPACING: 0.04, "solver.dx": 0.1}),
    "sand_to_foam": (["sim/sand", "sim/preview/sand", "sim/variants/sand_to_foam"], SMALLER["sand"]),
    # the flags of the bench, and their variants
    "bench_flag1": (["sim/flag1", "bench/flag1"], BENCH),
    "bench_flag2": (["sim/flag2", "bench/flag2"], BENCH),
    "bench_flag3": (["sim/flag3", "bench/flag3"], BENCH),
    **{
        f"bench_{name}": (["sim/flag3", "bench/flag3", f"bench/{name}"], BENCH | {SPACING: spacing})
        for name, spacing in (("flag4", 0.07), ("flag5", 0.02), ("curtain", 0.07), ("light", 0.06), ("pennant", 0.06))
    },
    **{
        f"bench_{path.stem}": (["sim/flag3", "bench/flag3", f"bench/variants/{path.stem}"], BENCH)
        for path in sorted(CONFIGS.glob("bench/variants/*"))
    },
    # what no shipped configuration has
    "rigid": (["sim/flag"], labelled(HELD, Part("cord"), Part("board", "rigid", density=60.0), Part("hem"))),
    "joint": (
        ["sim/flag"],
        labelled(
            HELD,
            Part("cloth"),
            Part("vane", attached="cloth", joint_turning=0.02),
            Part("flap", attached="vane", joint_stiffness=40.0),
            **{"scene.connected": "surface"},
        ),
    ),
    "modes": (["sim/ficus", "sim/preview/ficus"], {"solver.formulation": "modes"}),
    "laws": (
        ["sim/flag"],
        ALONE
        | {
            "material.law": "NeoHookean",
            "material.bending": 0.02,
            "aero.added_mass": 0.5,
            "aero.law": "cross_flow",
            "material.regions": [
                SOFT | {"region": box(0.3, 0.6), "law": named("StVKHencky")},
                SOFT | {"region": box(0.6, 0.9), "law": named("SpringNetwork")},
            ],
        },
    ),
    "flows": (
        ["sim/flag"],
        ALONE
        | {
            "solver.formulation": "updated",
            "aero.max_area_ratio": 1.0,
            "aero.law": "linear",
            "material.regions": [
                SOFT | {"region": box(0.2 * k, 0.2 * k + 0.2), "law": law}
                for k, law in enumerate(
                    [
                        named("Metal", yield_stress=300.0, hardening=1e3),
                        named("Foam", yield_stress=200.0, viscosity=5.0),
                        named("Plasticine", yield_stress=300.0, softening=0.1),
                        named("Snow"),
                        named("Fluid"),
                        named("NeoHookean"),
                    ]
                )
            ],
        },
    ),
    "boundaries": (
        ["sim/flag"],
        ALONE
        | {
            "solver.gravity": [0.0, 0.0, -3.0],
            "solver.stiffness_damping": 1e-3,
            "aero.drag_step": "semi_implicit",
            "solver.boundaries": [
                named("PinnedRegion", region=box(None, 0.1), kind="clamp"),
                named("PinnedRegion", region=box(1.1, None), velocity=[0.1, 0.3, 0.0]),
                named("Impulse", region=box(0.4, 0.6), impulse=[0.0, -0.05, 0.0]),
                named("Obstacle", shape=WALL, friction=0.4),
            ],
        },
    ),
    "effects": (
        ["sim/flag"],
        ALONE
        | {
            "aero.law": "projected",
            "wind.modulations": [named("UniformGust", delta=0.3)],
            "wind.effects": [
                named("Profile", height=2.0, exponent=0.14),
                named("Turbulence", intensity=0.3, length=1.0, cells=[32, 16, 16]),
                named("Obstacle", center=[-0.6, -0.1, 0.4], radii=[0.2, 0.1, 0.3]),
                named("Shelter", cells=16),
            ],
        },
    ),
    "edited": (
        ["sim/flag"],
        ALONE
        | {
            "forces": [named(f"{__name__}.Swirl")],
            "edits": [{"region": box(0.5, None), "time": 0.04, "E": 5e5, "density": 60.0, "color": [0.1, 0.6, 0.2]}],
        },
    ),
    "batch": (["sim/flag"], ALONE),
}
FRAMES = {"ball_on_cloth": 8, "cloth_over_ball": 7, "cloth_over_table": 5}  # until something touches
ENERGIES = ("kinetic", "elastic", "potential", "wind_work")


@cache
def parser():
    return Simulation.parser()


def simulation_of(name, folder, **arithmetic):
    files, settings = CASES[name]
    small = {"camera.init_args.width": 64, "camera.init_args.height": 48, **arithmetic}
    settings = small | (settings(folder) if callable(settings) else settings)
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in settings.items()}
    options = [text for file in files for text in ("--config", str(CONFIGS / f"{file}.yaml"))]
    options += [text for key, value in texts.items() for text in (f"--{key}", value)]
    return Simulation.from_settings(parser(), parser().parse_args(options), renderer=TorchRenderer())


def frames_of_batch(simulation):
    model = simulation.model
    batch = simulation.batch([model, model.at("wind.speed", 9.0), model.at("material.E", 2e4)])
    state = batch.start()
    while True:
        state, health = batch.advance(state)
        stretches = state.F_total @ state.F_total.mT
        yield state.position.flatten(0, 1), stretches.flatten(0, 1), health, None


def frames_of(name, folder, **arithmetic):
    simulation = simulation_of(name, folder, **arithmetic)
    if name == "batch":
        yield from frames_of_batch(simulation)
    for frame in simulation.frames(FRAMES.get(name, 3)):
        yield frame.gaussians.means, frame.gaussians.covariances, frame.health, frame


def run(name, folder, frames=None, **arithmetic):
    """Means (N, 3), covariances (N, 6), and energies (frames, 4) after some frames, and the last frame.

    Args:
        name: The case.
        folder: For files.
        frames: Number of frames; by default those of the case.
        arithmetic: Settings such as ``dtype``.
    """
    taken = list(islice(frames_of(name, folder, **arithmetic), frames or FRAMES.get(name, 3)))
    means, covariances, _, frame = taken[-1]
    row, column = torch.triu_indices(3, 3)
    energies = torch.tensor([[getattr(health, energy) for energy in ENERGIES] for _, _, health, _ in taken])
    found = {"means": means, "covariances": covariances[:, row, column], "energies": energies}
    return {key: value.detach().cpu().double().numpy() for key, value in found.items()}, frame


def picture(frame):
    """Of a frame, uint8 (48, 64, 3)."""
    color = frame.render().color.detach().cpu().clamp(0, 1)
    return (255 * color).round().numpy().astype(np.uint8)
