"""The flag benchmark of ``bench.py flags``: train, simulate, and compare with Blender's cloth."""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml

from bench.case import DATASET, FRAMES, MORE, NOTE, PICTURES, POINTS, Case, Measurement, at_once, names, option
from bench.cases.trained import GENTLE, last_psnr, tilts, train_command
from bench.record import ROOT, Row
from bench.simulate import simulate, what_failed
from bench.tables.plots import save_figure
from gaussian_swaying.evaluation.compare import compare_run

sys.path.append(str(ROOT / "tools" / "datasets"))  # scripts that import each other from their own folder

from flag_file import read_flag
from flag_reference import PAPER as PATTERNS
from flag_reference import PATTERNS as NUMBERED
from flag_reference import FlagPattern

BENCH = ROOT / "configs" / "bench"
Flag = int | str  # the number of a pattern, or the name of a file in configs/flags

REFERENCES: dict[Flag, FlagPattern] = {
    **NUMBERED,
    **{name: read_flag(ROOT / "configs" / "flags" / f"{name}.yaml") for name in ("curtain", "light", "pennant")},
}
"""All flags with a reference: the numbered patterns, and those of configs/flags."""


@dataclass(frozen=True)
class Variant:
    """One way to simulate a flag.

    Attributes:
        title: The name in the tables.
        overlays: Files of configs/bench/variants on top of the matched configuration.
        options: Other options of tools/sim.py.
        patterns: The flags for which it differs from ``ours``.
        training: Other options of tools/train.py; a variant with such options has its own splat.
        true_normals: Whether the Gaussians are turned to the reference's normals at rest.
        matched: Whether all volumes are scaled by one factor, so that the flag has the mass of ``ours``.
    """

    title: str
    overlays: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    patterns: tuple[Flag, ...] = tuple(REFERENCES)
    training: tuple[str, ...] = ()
    true_normals: bool = False
    matched: bool = False


def grid_options(dx: float) -> tuple[str, ...]:
    """Options for a grid spacing [m], with the same number of particles per cell."""
    return (f"--solver.dx={dx:g}", f"--scene.particle_spacing={0.45 * dx:g}")


_NEIGHBOURS = ("--scene.normals=neighbours",)
_IN_AIR = tuple(flag for flag in REFERENCES if flag != 1)  # pattern 1 falls in a vacuum
_CHANGES = ("--material.volume=cell", "--scene.layers=1", "--material.law=FixedCorotated", "--scene.area=equal")

VARIANTS: dict[str, Variant] = {
    "ours": Variant("ours (`total`, three layers)"),
    "to_volume": Variant("ours with volumes of grid cells", options=_CHANGES[:1], matched=True),
    "to_layer": Variant("... and one layer", options=_CHANGES[:2], matched=True),
    "to_law": Variant("... and fixed corotated", options=_CHANGES[:3], matched=True),
    "to_area": Variant("... and equal areas", options=_CHANGES, patterns=_IN_AIR, matched=True),
    "to_wind": Variant("... and wind without normals", ("no_normals",), _CHANGES, _IN_AIR, matched=True),
    "particle": Variant("... and no shading: PhysGaussian's way", ("particle",), matched=True),
    "own_volumes": Variant("PhysGaussian's way with its own volumes", ("particle",)),
    "no_surface": Variant("no surface modelling", ("no_surface",), patterns=_IN_AIR),
    "no_shading": Variant("no shading", ("no_shading",)),
    "gusts": Variant("flow randomised", ("gusts",), patterns=_IN_AIR),
    "paper_law": Variant("the paper's law and coefficients", ("paper_law",), patterns=_IN_AIR),
    "paper_area": Variant("patch areas π s1 s2", ("paper_area",)),
    "membrane": Variant("one layer (no bending stiffness)", options=("--scene.layers=1",)),
    "true_normals": Variant("with the reference's normals at rest", patterns=_IN_AIR, true_normals=True),
    "neighbours": Variant("normals of neighbouring centres", options=_NEIGHBOURS),
    "two_views": Variant("trained with two views, normals of neighbouring centres", (), _NEIGHBOURS, training=GENTLE),
    "one_point": Variant("one point per Gaussian", options=("--scene.particle_spacing=null",)),
    "total_04": Variant("`total`, dx = 0.04 m", options=grid_options(0.04)),
    "total_03": Variant("`total`, dx = 0.03 m", options=grid_options(0.03)),
    "total_02": Variant("`total`, dx = 0.02 m", options=grid_options(0.02)),
    "total_01": Variant("`total`, dx = 0.01 m", options=grid_options(0.01), patterns=(1, 2)),
    "updated_04": Variant("`updated`, dx = 0.04 m", ("updated",), grid_options(0.04)),
    "updated_03": Variant("`updated`, dx = 0.03 m", ("updated",), grid_options(0.03)),
    "updated_02": Variant("`updated`, dx = 0.02 m", ("updated",), grid_options(0.02)),
    "undamped": Variant("without the reference's damping", options=("--solver.damping=0",)),
    "linear": Variant("pressure linear in the cloth's speed", options=("--aero.law=linear",), patterns=_IN_AIR),
    "stiffness_damping": Variant("stiffness damping, 2.2 ms", options=("--solver.stiffness_damping=0.0022",)),
    "fixed_corotated": Variant("fixed corotated", options=("--material.law=FixedCorotated",)),
    "neo_hookean": Variant("neo-Hookean", options=("--material.law=NeoHookean",)),
    "thin": Variant("half the thickness, double E and density", ("thin",)),
    **{
        f"b_{b:g}": Variant(
            f"size loss b = {b:g}, no late split",
            training=(
                f"--model.loss_terms.size.init_args.b={b:g}",
                "--model.densification.init_args.split_at=null",  # otherwise it would make all sizes alike
            ),
            patterns=(3,),
        )
        for b in (0.001, 0.004, 0.008, 0.02, 0.1)
    },
}
"""All rows, by name."""


def folder_of(pattern: Flag) -> str:
    """Name of the folder of a flag in a data set."""
    return f"pattern{pattern}" if isinstance(pattern, int) else pattern


def flags_named(text: str) -> list[Flag]:
    """The flags in a list separated by commas; exits if one has no reference."""
    found: list[Flag] = [int(name) if name.isdigit() else name for name in text.split(",")]
    if unknown := [name for name in found if name not in REFERENCES]:
        raise SystemExit(f"--patterns takes {', '.join(map(str, REFERENCES))}, not {unknown[0]}")
    return found


def matched_configs(pattern: Flag) -> list[Path]:
    """The configuration files that match a reference, each on top of those before it."""
    base = pattern if pattern in PATTERNS else 3  # the others hang by their top edge like pattern 3
    files = [ROOT / "configs" / "sim" / f"flag{base}.yaml", BENCH / f"flag{base}.yaml"]
    own = f"flag{pattern}" if isinstance(pattern, int) else pattern
    return files if base == pattern else [*files, BENCH / f"{own}.yaml"]


def sim_arguments(pattern: Flag, variant: Variant, dataset: Path, splat: Path | None) -> list[str]:
    """Command line of tools/sim.py for a row."""
    configs = matched_configs(pattern)
    configs += [BENCH / "variants" / f"{name}.yaml" for name in variant.overlays]
    arguments = [part for path in configs for part in ("--config", str(path))]
    if splat is not None:
        arguments += ["--scene.ply", str(splat)]
    else:  # the same ripple: 3 mm more would change the incidence of the wind by over a degree
        arguments += [f"--scene.generator.init_args.ripple={REFERENCES[pattern].ripple}"]
    camera = dataset / folder_of(pattern) / "video" / "camera.json"
    if camera.exists():
        arguments += ["--camera=TransformsCamera", f"--camera.path={camera}"]
        described = json.loads(camera.read_text())
        arguments += [f"--camera.width={described['w']}", f"--camera.height={described['h']}"]
    arguments += list(variant.options)
    if {"particle", "no_surface", "no_normals"} & set(variant.overlays):  # friction equals drag
        arguments += [f"--aero.C_F={_given(pattern, 'aero')['C_D']}"]
    if "thin" in variant.overlays:
        arguments += [f"--material.{name}={2 * _given(pattern, 'material')[name]}" for name in ("E", "density")]
    return arguments


def _given(pattern: Flag, part: str) -> Row:
    """What the configuration files of a flag say in one of their parts."""
    found: Row = {}
    for path in matched_configs(pattern):
        found |= yaml.safe_load(path.read_text()).get(part, {})
    return found


_BUILD = threading.Lock()


@cache
def body_of(arguments: tuple[str, ...]) -> dict[str, float]:
    """Mass [kg], Young's modulus [Pa] and density [kg/m³] of a flag, from the options of tools/sim.py."""
    from gaussian_swaying.simulation.simulation import Simulation

    parser = Simulation.parser()
    settings = parser.parse_args([*arguments, "--device=cpu"])
    points = Simulation.from_settings(parser, settings).scene.points
    return {"mass": float(points.mass.double().sum()), "E": settings.material.E, "density": settings.material.density}


def of_equal_mass(arguments: Sequence[str], ours: Sequence[str]) -> tuple[list[str], float]:
    """Options that give a row the mass of ``ours``: all its volumes times one factor.

    Its density and Young's modulus are multiplied instead, which is the same: a point then has the weight and the
    elastic energy of a volume that many times as large.

    Args:
        arguments: Options of tools/sim.py for the row.
        ours: Those of ``ours``.

    Returns:
        The further options, and the factor.
    """
    with _BUILD:  # rows run in several threads
        own, wanted = (body_of(tuple(given)) for given in (arguments, ours))
    factor = wanted["mass"] / own["mass"]
    return [f"--material.{name}={factor * own[name]!r}" for name in ("E", "density")], factor


def train(pattern: Flag, variant: Variant, dataset: Path, target: Path, steps: int) -> Row:
    """Train a splat of a flag from its photos, unless it exists; the time it took is saved next to it."""
    account = target / "training.json"
    if (target / "point_cloud.ply").exists():
        return json.loads(account.read_text()) if account.exists() else {"kept": True}
    command = train_command(dataset / folder_of(pattern) / "train", variant.training, steps, target)
    begin = time.perf_counter()
    with (target.parent / f"{target.name}.log").open("w") as log:
        subprocess.run(command, check=True, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)
    row: Row = {"seconds": time.perf_counter() - begin, "steps": steps, "psnr_db": last_psnr(target)}
    account.write_text(json.dumps(row))
    return row


def turn_to_reference(splat: Path, cloth: Path, target: Path) -> None:
    """Write a splat whose Gaussians are turned, the shortest way, to the reference's normals at rest."""
    import numpy as np
    import torch

    from gaussian_swaying.gaussians.ply import read_ply, write_ply
    from gaussian_swaying.geometry.neighbours import nearest_neighbours
    from gaussian_swaying.geometry.patches import smallest_axis_normal
    from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat

    cloud = read_ply(splat)
    with np.load(cloth) as reference:
        vertices = torch.from_numpy(reference["positions"][0].astype(np.float64))
        normals = torch.from_numpy(reference["rest_normals"].astype(np.float64))
    own = smallest_axis_normal(cloud.quats.double(), cloud.scales.double())
    true = normals[nearest_neighbours(vertices, 1, cloud.means)[1][:, 0]]
    true = torch.where((own * true).sum(-1, keepdim=True) < 0, -true, true)
    arc = torch.cat([1 + (own * true).sum(-1, keepdim=True), torch.linalg.cross(own, true)], -1)
    turned = rotation_to_quat(quat_to_rotation(arc) @ quat_to_rotation(cloud.quats.double()))
    write_ply(target, replace(cloud, quats=turned.to(cloud.quats), normals=None))


def run_row(
    pattern: Flag,
    variant: Variant,
    options: argparse.Namespace,
    splat: Path | None,
    output: Path,
    pictures: bool = True,
) -> Row:
    """Simulate a row into the folder ``output`` and compare it with the reference, with ``pictures`` if it has all."""
    dataset = Path(options.dataset)
    reference = dataset / folder_of(pattern)
    more = options.more.split()
    arguments = own = sim_arguments(pattern, variant, dataset, splat) + more
    matched: Row = {}
    if variant.matched:
        ours = sim_arguments(pattern, VARIANTS["ours"], dataset, splat) + more
        scaled, matched["volume_factor"] = of_equal_mass(own, ours)
        arguments = own + scaled
    if not pictures or len(list((reference / "video" / "frames").glob("*.png"))) != 250:  # they may not be finished yet
        bare = output.parent / f"surface_{pattern}"
        bare.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):  # another row made it
            (bare / "cloth.npz").symlink_to((reference / "cloth.npz").resolve())
        reference = bare
        arguments = [*arguments, "--recorder.images=false", "--recorder.video=false"]
    summary = simulate(arguments, output, options.device, options.frames)
    if "failed" in summary:
        return summary
    row: Row = {key: summary[key] for key in ("status", "reason", "particles", "frames", "substeps")}
    drawn = sum(summary["wall_s"].get(part, 0.0) for part in ("simulation", "shading", "rendering"))
    row["ms_per_frame"] = 1e3 * drawn / max(summary["frames"], 1)
    row["device_memory_bytes"] = summary["peak_memory_bytes"]["device"]
    row |= {key: summary[key] for key in ("torn_particles", "stretch_max", "mass_kg")} | matched
    on = "cuda" if summary["peak_memory_bytes"]["device"] is not None else "cpu"  # the device of the run
    frames = options.frames or summary["frames"]
    found = compare_run(output, reference, frames=frames, points=options.points, device=on)
    row |= {key: found[key] for key in ("chamfer_share", "sampling_m", "psnr_of_mean_db") if key in found}
    row["mean"] = found["mean"]
    row["chamfer_per_frame_m"] = [entry.get("chamfer_m") for entry in found["per_frame"]]
    (output / "trajectory.npz").unlink(missing_ok=True)  # gigabytes, and the figure needs only the pictures
    return row


_TIMES = (0.05, 0.2, 0.4, 0.6, 0.95)  # times of a figure, as shares of the run


def figure(reference: Path, runs: dict[str, Path], target: Path) -> bool:
    """Draw reference, ours, PhysGaussian's way and our error at five times; False if pictures are missing."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np
    from imageio.v3 import imread

    folders = {"reference": reference / "video" / "frames"}
    folders |= {name: runs[name] / "frames" for name in ("ours", "particle") if name in runs}
    files = {name: sorted(folder.glob("*.png")) for name, folder in folders.items()}
    count = min(map(len, files.values()))
    if len(files) < 3 or count < 250:
        return False
    rows = [*files, "error of ours"]
    drawn, axes = plt.subplots(len(rows), len(_TIMES), figsize=(12, 12 * len(rows) / len(_TIMES) * 0.62))
    for column, share in enumerate(_TIMES):
        frame = round(share * (count - 1))
        seen = {name: imread(files[name][frame])[..., :3] for name in files}
        wrong = np.abs(seen["ours"].astype(float) - seen["reference"].astype(float)).mean(-1)
        for row, name in enumerate(rows):
            axis = axes[row, column]
            if name in seen:
                axis.imshow(seen[name])
            else:
                axis.imshow(wrong, cmap="magma", vmin=0, vmax=255)
            axis.set_xticks([])
            axis.set_yticks([])
            if column == 0:
                axis.set_ylabel("PhysGaussian's way" if name == "particle" else name)
            if row == 0:
                axis.set_title(f"{0.04 * frame:.2f} s")
    drawn.tight_layout()
    save_figure(drawn, target)
    return True


def splat_folder(options: argparse.Namespace, name: str, pattern: Flag) -> Path:
    """Folder of the splat of a row; rows without a training of their own share one."""
    return Path(options.splats) / folder_of(pattern) / (name if VARIANTS[name].training else "all_losses")


def _train(options: argparse.Namespace, target: Path, name: str, pattern: Flag) -> Row:
    """The account of the training of a splat, or why it failed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        row = train(pattern, VARIANTS[name], Path(options.dataset), target, options.train_steps)
    except subprocess.CalledProcessError:
        row = {"failed": what_failed((target.parent / f"{target.name}.log").read_text())}
    return row | ({"at_once": options.at_once} if options.at_once > 1 else {})


def open_dataset(dataset: Path, patterns: Sequence[Flag], result: Row) -> None:
    """Check that the references exist, and copy what is known of their uncertainty into the record."""
    for pattern in patterns:
        folder = dataset / folder_of(pattern)
        if not (folder / "cloth.npz").exists():
            raise SystemExit(
                f"{dataset} has no {folder.name}/cloth.npz: make it with tools/datasets/make_flag_dataset.py"
            )
        path = folder / "uncertainty.json"
        if path.exists():
            known = json.loads(path.read_text())["variants"]
            kept = {name: {k: v for k, v in found.items() if k != "chamfer_per_frame"} for name, found in known.items()}
            result.setdefault("uncertainty", {})[str(pattern)] = kept


def _row(options: argparse.Namespace, name: str, pattern: Flag, trained: dict[str, Row], scratch: Path) -> Row:
    """Simulate and compare a row, with its splat if splats are trained."""
    variant, splat, row = VARIANTS[name], None, dict[str, Any]()
    if options.splats != "made":
        target = splat_folder(options, name, pattern)
        row["training"] = trained[str(target)]
        splat = target / "point_cloud.ply"
        cloth = Path(options.dataset) / folder_of(pattern) / "cloth.npz"
        if splat.exists() and variant.true_normals:
            own, splat = splat, scratch / f"{name}_{pattern}.ply"
            turn_to_reference(own, cloth, splat)
        if splat.exists() and (variant.training or name == "ours"):
            row["tilt"] = tilts(splat, cloth)
    if splat is not None and not splat.exists():
        row["failed"] = row["training"].get("failed", "no splat")
    else:
        row |= run_row(pattern, variant, options, splat, scratch / f"{name}_{pattern}")
    return row | ({"sims_at_once": options.sims_at_once} if options.sims_at_once > 1 else {})


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Train the splats that the rows need, simulate and compare all rows, and draw the figures."""
    patterns, made = flags_named(options.patterns), options.splats == "made"
    if not made and (other := [p for p in patterns if p not in PATTERNS]):
        raise SystemExit(f"{other[0]} has no photos to train a splat from: add `--splats made`")
    open_dataset(Path(options.dataset), patterns, result)
    result["splats"] = "made in code" if made else f"trained, {options.train_steps} images"
    result |= {"more": options.more} | ({"note": options.note} if options.note else {})
    jobs = [(name, p) for name in options.rows for p in patterns if p in VARIANTS[name].patterns]
    if made:  # there is nothing to train, and the normals are right
        jobs = [job for job in jobs if not VARIANTS[job[0]].training and not VARIANTS[job[0]].true_normals]
    splats = {} if made else {splat_folder(options, *job): job for job in jobs}
    trainings = (((str(target),), partial(_train, options, target, *job)) for target, job in splats.items())
    trained = {place[0]: work() for place, work in at_once(options.at_once, trainings)}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        works = ((("rows", name, str(p)), partial(_row, options, name, p, trained, scratch)) for name, p in jobs)
        yield from at_once(options.sims_at_once, works)
        for pattern in patterns:
            runs = {n: scratch / f"{n}_{pattern}" for n in options.rows if (scratch / f"{n}_{pattern}").is_dir()}
            target = Path(options.pictures) / f"flags_{folder_of(pattern)}.png"
            if figure(Path(options.dataset) / folder_of(pattern), runs, target):
                yield ("figures", str(pattern)), {"file": target.name, "way": "particle"}.copy


CASE = Case(
    "Train, simulate and compare the flags of the paper with Blender's cloth.",
    rows,
    (
        DATASET,
        names("--rows", VARIANTS),
        option("--patterns", "separated by commas", default="1,2,3"),
        option("--splats", "folder of the trained splats; `made` for splats made in code, without training",
               default="outputs/flags"),
        option("--train_steps", "images of a training run", type=int, default=7000),
        option("--at_once", "training runs at the same time", type=int, default=1),
        option("--sims_at_once", "simulations at the same time; their times then mean little", type=int, default=1),
        FRAMES,
        POINTS,
        PICTURES,
        MORE,
        NOTE,
    ),
    name=lambda options: "flags_made" if options.splats == "made" else "flags",
)  # fmt: skip
