"""Names that configurations no longer have, and what took their place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_KINDS = {
    "Alocasia": "alocasia",
    "FicusBehindWall": "ficus_behind_wall",
    "Ficus": "ficus",
    "Leaves": "leaves",
    "PlantRow": "plant_row",
    "Sand": "sand",
    "Telephone": "telephone",
    "Vase": "vase",
}

GONE = {
    **{f"{name}Scene": f"DemoScene with `kind: {kind}` and `count`" for name, kind in _KINDS.items()},
    "ClothScene": "DemoScene with `kind` cloth_over_ball, cloth_over_table, ball_on_cloth or two_flags, and `size`",
    **{f"{name}Obstacle": f"Obstacle with `shape: {name}`" for name in ("Box", "Capsule", "HalfSpace", "Mesh")},
    "EnclosingBox": "Wall with `shape: Box`",
    "Plane": "Wall with `shape: HalfSpace`",
    "Handle": "PinnedRegion with `velocity`, `angular_velocity` and `pivot`",
    "SequentialRelease": "PinnedRegion with a `front`",
    "KeyframedCamera": "LookAtCamera with `keys`",
    "TransformsCamera": "CaptureCamera with `view`",
    **{f"{name}Camera.near": "the default, a hundredth of the distance" for name in ("Orbit", "LookAt", "Capture")},
    "recorder.images": "`recorder.renders`, which may be empty",
    "contact.iterations": "the default, 100",
    "air.lattice_speed": "`air.speed`",
    **{f"{name}Camera.interpolation": "the default, smooth" for name in ("LookAt", "Capture")},
    **{f"SolidScene.{name}": "the default" for name in ("jitter", "overlap", "seed")},
    "VelocityBox.travels": "nothing, as all do",
    "PhongShader": "DiffuseShader with `ambient`",
    "LogProfile": "Profile",
    "PowerProfile": "Profile with an `exponent`",
    "CylinderObstacle": "Obstacle with a null among its `radii`",
    "EllipsoidObstacle": "Obstacle",
    "BallObstacle": "Obstacle with `shape: Sphere`",
    "fit.wind_changes": "`until`, for a part of the film in which the wind is steady",
    "fit.stages": "nothing, as points are always followed and then matched",
    "fit.fit_share": "`until`, a time [s]",
    "fit.starts": "nothing: three starts go on",
    "fit.seed": "nothing: the search is always the same",
    "PhysGaussianCamera": "OrbitCamera, or another camera",
    "DepthNormalLoss": "MultiViewGeometricLoss",
    "AnisotropyLoss.ratio": "the default, the paper's",
    "PhotometricLoss.padding": "the default, windows inside the picture",
    "DefaultDensification.reset_opacity": "nothing, as no recipe did it",
    "FlagOnStandScene": "FlagScene with `stand: pole`",
}
"""What to use in place of classes, fields of classes (``Class.field``) and other fields (``scene.field``)."""


def refuse_gone(found: Any, within: str = "") -> Any:
    """Return what was read from YAML; ValueError if it has a name that is gone."""
    if isinstance(found, Mapping):
        kind = str(found.get("class_path", "")).rpartition(".")[-1]
        for name, value in found.items():
            own = kind if name == "init_args" else f"{within}.{name}".lstrip(".")
            _refuse(own)
            refuse_gone(value, own)
    elif isinstance(found, list):
        for value in found:
            refuse_gone(value, within)
    elif isinstance(found, str):
        _refuse(found.rpartition(".")[-1])
    return found


def _refuse(name: str) -> None:
    if name in GONE:
        raise ValueError(f"`{name}` is gone: use {GONE[name]}.")
