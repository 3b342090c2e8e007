"""Malformed configurations, captures and run folders, faults of the disk, and extreme numbers, each from a seed."""

import copy
import functools
import json
import os
import random
import shutil
import tempfile
from pathlib import Path

import yaml
from damage import changed, damaged
from shared import SMALL, png, words
from small_captures import arc, write_colmap, write_transforms

ROOT = Path(__file__).parents[2]
FLAG = ROOT / "configs/sim/flag.yaml"
RUN = ["--config", str(FLAG), "--frames", "2", "--device", "cpu", "--output", "run", *words(SMALL)]
RUN += ["--recorder.checkpoint_every", "1"]
TAGS = ("!!python/object/apply:os.system ['true']", "!!binary aGVsbG8=", "!!set {a, b}", "!!float x", "!unknown 3")
NUMBERS = ("0", "-1", "1e-30", "1e-9", "1e-3", "0.4999999", "1e3", "1e6", "1e9", "1e12", "1e30", "1e300", "nan", "inf")
NUMBERS += ("-inf", "1000000000", "60000", "9223372036854775808", "9" * 400, "-0.0", "1e-320")
CLASSES = (  # numbers of parts that are no options of their own; not the spacing, as a million Gaussians take 2 GB
    "camera.init_args.width", "camera.init_args.height", "camera.init_args.radius", "camera.init_args.fov_y",
    "camera.init_args.elevation", "shader.init_args.ambient",
)  # fmt: skip


def unusable(rng, path, *more):
    path.unlink()
    rng.choice((lambda path: None, Path.mkdir, *more))(path)


def _tree():
    tree = yaml.safe_load(FLAG.read_text(encoding="utf-8"))
    tree["frames"], tree["solver"]["dx"] = 2, 0.2
    tree["solver"]["boundaries"] = copy.deepcopy(SMALL["solver.boundaries"])  # it will be changed
    tree["scene"]["generator"]["init_args"]["spacing"] = 0.1
    tree["camera"]["init_args"] |= {"width": 32, "height": 18}
    return tree


def _bomb(rng):
    width, depth = rng.choice((2, 9, 30)), rng.choice((3, 12, 40))
    lines = ["a0: &a0 [" + ", ".join(["1"] * width) + "]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * width)}]" for i in range(1, depth)]
    return "\n".join([*lines, f"{rng.choice(('background', 'edits', 'wind', 'x'))}: *a{depth - 1}", ""])


def _tagged(rng):
    lines = yaml.safe_dump(_tree(), sort_keys=False).splitlines()
    index = rng.choice([i for i, line in enumerate(lines) if ": " in line])
    return "\n".join([*lines[:index], lines[index].split(": ")[0] + ": " + rng.choice(TAGS), *lines[index + 1 :]])


YAMLS = (
    *[lambda rng: yaml.safe_dump(changed(rng, _tree()), allow_unicode=True)] * 6,
    *[lambda rng: damaged(rng, yaml.safe_dump(_tree(), sort_keys=False).encode())] * 4,
    _bomb,
    _tagged,
    lambda rng: rng.choice(("wind: &a [*a, *a]\n", "edits: &a {flow: *a, b: [*a]}\n", "scene: &a [*a]\n")),
    lambda rng: (
        rng.choice(("wind: ", "background: ", "")) + rng.choice(("[", "{a: ", "- ")) * rng.choice((60, 200_000))
    ),
    lambda rng: (
        "edits:\n" + rng.choice(("- {time: 1.0, E: 2.0}\n", "- - a\n", "# none\n")) * rng.choice((500, 400_000))
    ),
    lambda rng: "output: Blüte é\n".encode(rng.choice(("latin-1", "utf-16", "utf-32", "utf-8-sig", "utf-7", "cp037"))),
)


def yaml_case(rng, folder):
    text = rng.choice(YAMLS)(rng)
    (folder / "bad.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    return ["sim", "--config", str(folder / "bad.yaml"), "--device", "cpu", "--output", "run"]


def capture_case(rng, folder):
    poses, names = arc(4), [f"images/{k}.png" for k in range(4)]
    if rng.random() < 0.4:
        write_colmap(folder, poses, [Path(name).name for name in names], binary=rng.random() < 0.6)
        texts = sorted((folder / "sparse/0").iterdir())
    else:
        write_transforms(folder, poses, names)
        texts = [folder / "transforms.json"]
    path = rng.choice([*texts, *texts, rng.choice(sorted(folder.rglob("*.png")))])
    kind = rng.random()
    if path.suffix == ".png" and kind < 0.4:
        side = rng.choice((1, 9000, 13_000, 60_000, 2**31 - 1))
        path.write_bytes(png(side, side, bytes(10_000_000)))
        if texts[0].name == "transforms.json" and rng.random() < 0.7:  # the camera agrees
            texts[0].write_text(json.dumps(json.loads(texts[0].read_text()) | {"w": side, "h": side}))
    elif path.suffix == ".json" and kind < 0.6:
        path.write_text(json.dumps(changed(rng, json.loads(path.read_text()))))
    elif kind < 0.9:
        path.write_bytes(damaged(rng, path.read_bytes()))
    else:
        unusable(rng, path, os.mkfifo)
    if rng.random() < 0.1:
        count, kind = rng.choice(("3", "-1", "4000000000", "9" * 30)), rng.choice(("float", "list uchar float"))
        head = f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty {kind} x\nproperty float y\nproperty float z\n"
        (folder / "points3d.ply").write_bytes(head.encode() + b"end_header\n" + b"1 2 3\n" * 3)
    if rng.random() > 0.08:
        return ["look", str(folder)]
    given = {"trainer.max_steps": 1, "trainer.default_root_dir": "out", "data": "CaptureDataModule"}
    given |= {"data.init_args.workers": 0, "data.init_args.point_count": 50, "data.init_args.path": str(folder)}
    return ["train", "fit", "--config", "quick_cpu", *words(given)]


@functools.cache
def _run():
    from gaussian_swaying.cli.simulate import main

    folder = Path(tempfile.mkdtemp(prefix="series-run-")) / "run"
    assert main([*RUN, "--output", str(folder)]) == 0
    return folder


def folder_case(rng, folder):
    run = shutil.copytree(_run(), folder.parent / "run")
    names = ("checkpoint.pt", "trajectory.npz", "frames/00001.png", "summary.json", "config.yaml", "run.json")
    path = run / rng.choices(names, (8, 4, 3, 3, 2, 2))[0]
    if rng.random() < 0.8:
        content = path.read_bytes()
        cut = path.suffix in (".pt", ".npz")  # bits that change within them are not looked for
        path.write_bytes(content[: rng.randrange(len(content))] if cut else damaged(rng, content))
    else:
        unusable(rng, path)
    if rng.random() < 0.2:
        return ["eval", str(run), str(_run()), "--output", "out", "--device", "cpu", "--points", "100", "--no-video"]
    return ["sim", *RUN, *(["--frames", "3", "--resume"] if rng.random() < 0.9 else [])]


@functools.cache
def _splat():
    """A flag of 96 Gaussians as a .ply file."""
    from gaussian_swaying.gaussians.ply import write_ply
    from gaussian_swaying.scenes.procedural import FlagScene

    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "flag.ply", FlagScene(spacing=0.1).generate())
        return (Path(folder) / "flag.ply").read_bytes()


def disk_case(rng, folder):
    (folder / "full").mkdir()
    for name in ("file", "full/notes.txt"):
        (folder / name).write_text("mine")
    (folder / "link").symlink_to(folder / "nowhere")
    os.mkfifo(folder / "pipe")
    splat = str(folder / "flag.ply")
    (folder / "flag.ply").write_bytes(_splat())
    places = ["/dev/full", "/dev/null", "/proc/x", "", "a\0b", "x" * 300]
    places += [str(folder / name) for name in ("file", "link", "pipe", "full", "file/below")]
    out = rng.choice(["out", *places]) if rng.random() < 0.5 else "out.splat"
    given = ["sim", *RUN, "--output", out], ["export", splat, out]
    return rng.choice((*given, ["preview", splat, "--device", "cpu", "--height", "64", "--output", out]))


@functools.cache
def _fields():
    """Options that are numbers (1) or lists of three (3)."""
    from gaussian_swaying.simulation.simulation import Simulation

    found = dict.fromkeys(CLASSES, 1)
    for action in Simulation.parser()._actions:
        kind = str(getattr(action, "_typehint", None) or getattr(action, "type", None))
        if action.dest.startswith(("help", "config")) or "cls" in kind:
            continue
        if any(f"{name}[float" in kind for name in ("equence", "list", "tuple")):
            found[action.dest] = 3
        elif "float" in kind or "int" in kind:
            found[action.dest] = 1
    return found


def extreme_case(rng, folder):
    """One or two numbers of a configuration."""
    given = []
    for name in rng.sample(sorted(_fields()), rng.choice((1, 1, 1, 2))):
        values = [rng.choice(NUMBERS) for _ in range(_fields()[name])]
        given += [f"--{name}={values[0] if len(values) == 1 else '[' + ', '.join(values) + ']'}"]
    return ["sim", *RUN, *given]


SERIES = {
    "yaml": (yaml_case, 900), "capture": (capture_case, 700), "folder": (folder_case, 400), "disk": (disk_case, 300),
    "extreme": (extreme_case, 400),
}  # fmt: skip
"""Functions that write an input into a folder and give the command line, and the number of cases at night."""


def case(name, number):
    """A function that makes a case, and the largest file that its process may write; 0 for any."""
    rng = random.Random(f"{name} {number}")
    full = int(10 ** rng.uniform(0, 5)) if name == "disk" and rng.random() < 0.5 else 0
    return functools.partial(SERIES[name][0], rng), full
