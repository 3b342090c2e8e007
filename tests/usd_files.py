"""What another program finds in a USD file of Gaussians."""

from pathlib import Path

import numpy as np

HARMONICS = "radiance:sphericalHarmonicsCoefficients"
NAMES = ("positions", "orientations", "scales", "opacities", "harmonics", "colors")


def read_usd_frame(path: Path, frame: int) -> dict[str, np.ndarray]:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))  # a prim lives as long as its stage
    prim = stage.GetPrimAtPath("/World/Gaussians")
    names = {"harmonics": HARMONICS, "colors": "primvars:displayColor"}
    found = {name: prim.GetAttribute(names.get(name, name)).Get(frame) for name in NAMES}
    normals = UsdGeom.PrimvarsAPI(prim).GetPrimvar("normals")
    arrays = {name: np.array(value, dtype=np.float32) for name, value in found.items()}
    arrays["normals"] = np.array(normals.Get(frame), dtype=np.float32)
    arrays["orientations"] = arrays["orientations"][:, [3, 0, 1, 2]]
    arrays["harmonics"] = arrays["harmonics"].reshape(len(arrays["positions"]), -1, 3)
    return arrays
