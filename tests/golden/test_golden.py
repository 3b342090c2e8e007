"""Small runs end where they ended before: kernels in float32, torch in float64 (kernels for contact), and a GPU.

A record has the distance between its run in float32 and the same run in float64: one sample of the rounding as it has
grown. Others, on two more kinds of processor and a GPU, were up to 17 times as large for single numbers such as an
energy, so 32 times are allowed, and 2^-29 of that in float64. The rest is four units in the last place of float32, to
which records are rounded, and in float64 1e-6 of the largest number, as areas, masses and normals are found in float32
in any case; 3e-3 for modes, where the linear algebra of the machine decides which of the weakest Ritz vectors are
kept (one thread and two differ by 1.3e-3 in the elastic energy). Of a picture, 3 % may differ, as Gaussians at one
depth are drawn in another order.

If a change of the physics is meant, ``python tests/golden/make.py`` with the names of the cases writes new records.
"""

import numpy as np
import pytest
from golden.make import FILES, in_double, scale
from golden.small_runs import CASES, CONFIGS, picture, run

GROWTH = 32.0
QUANTUM = 2.0**-22


def check(name, kind, found, growth, share):
    """Positions, covariances and energies are those of a record, but for its rounding times ``growth``."""
    with np.load(FILES / f"{name}.npz") as record:
        assert len(found["means"]) == record["count"]
        for key, values in found.items():
            if key != "energies":
                values = values[record["index"]]
            expected = record[f"{kind}_{key}"].astype(float)
            bound = growth * record[f"rounding_{key}"] + share * scale(key, expected)
            error = np.abs(values - expected)
            assert (error <= bound).all(), f"{key}: {(error / (bound + 1e-300)).max():.3g} times the bound"
        return record.get("picture")


@pytest.fixture
def folder(tmp_path, monkeypatch, request):
    """An empty one, in which analyses of modes are kept, too, so that none is from other code."""
    if request.node.callspec.params["name"] == "modes":
        monkeypatch.setenv("GAUSSIAN_SWAYING_CACHE", str(tmp_path / "cache"))
    return tmp_path


@pytest.mark.parametrize("name", CASES)
def test_kernels(name, folder, kernel_device):
    more = {"solver.deterministic": True} if kernel_device.type == "cuda" and name != "modes" else {}
    found, frame = run(name, folder, device=kernel_device.type, **more)
    kept = check(name, "kernels", found, GROWTH, QUANTUM)
    if frame is not None:
        differs = np.abs(picture(frame).astype(int) - kept) > 2
        assert differs.mean() < 0.03


@pytest.mark.parametrize("name", CASES)
def test_torch(name, folder):
    found, _ = run(name, folder, 2, device="cpu", **in_double(name))
    check(name, "torch", found, GROWTH * 2.0**-29, 3e-3 if name == "modes" else 1e-6)


def test_every_shipped_configuration_has_a_case():
    used = {f"{name}.yaml" for files, _ in CASES.values() for name in files}
    paths = {
        path.relative_to(CONFIGS).as_posix() for room in ("sim", "bench") for path in CONFIGS.rglob(f"{room}/**/*.yaml")
    }
    assert used == paths - {"bench/train.yaml", "bench/two_views.yaml"}
