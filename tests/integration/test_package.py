"""What a user of the package as a whole relies on: names, light imports, the rule for GPU tests, shipped files."""

import ast
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import yaml

import gaussian_swaying

ROOT = Path(__file__).resolve().parents[2]


def _python(*arguments, **environment):
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | environment,
        check=False,
    )


def test_every_public_name_is_found_in_its_home():
    stub = ast.parse((ROOT / "gaussian_swaying" / "__init__.pyi").read_text())
    listed = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    homes = {node.module: [a.name for other in listed if other.module == node.module for a in other.names]
             for node in listed}  # fmt: skip
    assert sorted(name for names in homes.values() for name in names) == sorted(gaussian_swaying.__all__)
    assert 35 <= len(gaussian_swaying.__all__) <= 50
    for home, names in homes.items():
        module = import_module(f"gaussian_swaying.{home}")
        for name in names:
            assert getattr(gaussian_swaying, name) is getattr(module, name)
            assert getattr(module, name).__doc__
    with pytest.raises(AttributeError, match="Windmill"):
        gaussian_swaying.Windmill  # noqa: B018


def test_import_is_light_and_every_module_imports_without_the_heavy_libraries():
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((ROOT / "gaussian_swaying").rglob("*.py"))
    ]
    lightning_classes = {"training.data.datamodule", "training.data.generated_datamodule", "cli.train"}
    lightning_classes |= {f"training.{name}" for name in ("lightning_cli", "module", "run_folder")}
    lightning_classes |= {"metrics.frechet_video"}
    modules = [m for m in modules if m.removeprefix("gaussian_swaying.") not in lightning_classes]
    assert len(modules) > 25
    heavy = [
        "gsplat",
        "lightning",
        "torchmetrics",
        "plyfile",
        "imageio",
        "imageio_ffmpeg",
        "jsonargparse",
        "matplotlib",
    ]
    done = _python(
        "-c", f"import sys\nfor m in {modules}: __import__(m)\nprint([h for h in {heavy} if h in sys.modules])"
    )
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_a_run_imports_only_what_it_needs(tmp_path):
    heavy = ["cv2", "gsplat", "imageio", "lightning", "matplotlib", "pandas", "PIL.TiffImagePlugin", "scipy.optimize"]
    heavy += ["scipy.stats", "setuptools", "sympy", "torch._dynamo", "torch._inductor", "torch.utils.cpp_extension"]
    heavy += ["torchmetrics", "triton", "aiohttp"]
    small = ["--config=flag", "--scene.generator.init_args.spacing=0.05", "--solver.dx=0.1", "--frames=2"]
    small += ["--camera.init_args.width=32", "--camera.init_args.height=18", "--device=cpu", f"--output={tmp_path}"]
    run = f"import sys; from gaussian_swaying.cli.main import main; main(['sim', *{small}])"
    done = _python("-c", f"{run}\nprint([name for name in {heavy} if name in sys.modules])", TRITON_INTERPRET="0")
    assert done.stdout.splitlines()[-1:] == ["[]"], done.stdout + done.stderr
    assert (tmp_path / "video.mp4").is_file()


def test_every_dependency_is_pinned():
    tomllib = pytest.importorskip("tomllib", reason="needs Python 3.11")
    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = re.search(r'-e "\.\[(.+)\]" && pytest$', (ROOT / "README.md").read_text(), re.MULTILINE)[1].split(",")
    named = [line for extra in extras for line in project["optional-dependencies"][extra]]
    assert extras == ["dev", "netcdf", "parquet", "usd", "webdataset"]  # the light ones, so that their tests run
    needed = [Requirement(line) for line in [*project["dependencies"], *named]]
    pins = [Requirement(line) for line in (ROOT / "constraints.txt").read_text().splitlines() if line[:1].isalnum()]
    assert all(len(pin.specifier) == 1 and str(pin.specifier).startswith("==") for pin in pins)
    valid = {pin.name: str(pin.specifier) for pin in pins if pin.marker is None or pin.marker.evaluate()}
    assert len(needed) > 15
    for requirement in needed:
        assert requirement.specifier.contains(valid[requirement.name.lower()].removeprefix("==")), requirement
    assert valid["torch"] == "==2.13.0"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == project["version"] == gaussian_swaying.__version__
    assert citation["license"] == project["license"]
