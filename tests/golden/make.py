"""Writes the frames that test_golden.py compares: python tests/golden/make.py [case ...].

A file has what some 200 Gaussians of a case are after its frames in compiled kernels (float32), what they are after
two frames in torch (float64), and, for each quantity, how far the two arithmetics are apart after all frames: that is
the rounding of float32 as it has grown through the run, whatever the mechanics does with it.

The same bytes on one machine mean that nothing has changed, not even a rounding.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1]))
from golden.small_runs import CASES, picture, run

FILES = Path(__file__).parent / "files"
TOUCHING = {
    "ball_on_cloth", "boundaries", "cloth_over_ball", "cloth_over_table", "flag", "flag1_pole", "leaves_contact",
    "two_flags",
}  # fmt: skip
"""Cases with contact, which kernels compute in float64, too."""


def in_double(name):
    """Settings of a run in float64, in torch where that is possible."""
    return {"solver.transfer": "auto" if name in TOUCHING else "torch", "dtype": "float64"}


KEPT = 200


def scale(key, values):
    """What an error is a share of: for energies the largest of each, otherwise the largest number."""
    return np.abs(values).max(0 if key == "energies" else None)


def record(name, folder):
    kernels, frame = run(name, folder, device="cpu")
    if name == "modes":
        for path in folder.glob("**/modes_*.npz"):
            path.unlink()
    early, _ = run(name, folder, 2, device="cpu", **in_double(name))
    exact, _ = run(name, folder, device="cpu", **in_double(name))
    start, _ = run(name, folder, 1, device="cpu")
    moved = np.abs(kernels["means"] - start["means"]).max(1)
    (index,) = np.nonzero(moved > 0.01 * moved.max())
    index = index[np.linspace(0, len(index) - 1, min(KEPT, len(index))).round().astype(int)]
    made = {"index": index.astype(np.uint32), "count": np.int64(len(moved))}
    for key, values in kernels.items():
        error = np.abs(values - exact[key])
        made[f"rounding_{key}"] = error.max(0 if key == "energies" else None).astype(np.float32)
        for kind, given in (("kernels", values), ("torch", early[key])):
            made[f"{kind}_{key}"] = (given if key == "energies" else given[index]).astype(np.float32)
    if frame is not None:
        made["picture"] = picture(frame)
    shares = [np.max(made[f"rounding_{key}"] / (scale(key, values) + 1e-30)) for key, values in kernels.items()]
    print(f"{name}: {moved.max():.1e} m, rounding", *[f"{share:.0e}" for share in shares], flush=True)
    return made


if __name__ == "__main__":
    FILES.mkdir(exist_ok=True)
    for case in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            if case == "modes":  # an analysis of other code, or of the body in the other precision, is in no cache
                patch.setenv("GAUSSIAN_SWAYING_CACHE", folder)
            np.savez_compressed(FILES / f"{case}.npz", **record(case, Path(folder)))
