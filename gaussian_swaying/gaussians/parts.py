"""Parts of a splat: a label for each Gaussian, and for each label a role and a material, in one small file.

``parts.npz`` lies beside the splat and has these arrays, for N Gaussians and P parts:

=================  ==========================  =======================================================================
``count``          int64, ()                   N, so that the parts of another splat are noticed
``labels``         uint8, or uint16, (N,)      the part of each Gaussian, in the order of the splat
``names``          text, (P,)                  the names of the parts
``roles``          text, (P,)                  ``soft``, ``rigid``, ``held``, ``still`` or ``hidden``
``E``              float64, (P,)               Young's modulus [Pa]; NaN for that of the object, here and below
``nu``             float64, (P,)               Poisson's ratio
``density``        float64, (P,)               density [kg/m³]
``thickness``      float64, (P,)               thickness of the surface [m]
``damping_ratio``  float64, (P,)               damping ratio; may be missing
``attached``       text, (P,)                  the only part to which a part is attached; empty for any; may be missing
``joint_...``      float64, (P,)               ``stiffness`` [N/m] and ``turning`` [N m/rad] of joints; may be missing
=================  ==========================  =======================================================================
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_plain, check_poisson_ratio, check_positive, check_shape
from gaussian_swaying._files import atomic
from gaussian_swaying._fixed import Fixed, fixed
from gaussian_swaying._inputs import read_arrays
from gaussian_swaying.geometry.regions import Region

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

ROLES = ("soft", "rigid", "held", "still", "hidden")
NUMBERS = ("E", "nu", "density", "thickness", "damping_ratio")
JOINT = ("joint_stiffness", "joint_turning")
LONGEST_NAME = 100
MOST = 1 << 16  # parts of a file: labels are uint16


@fixed
@dataclass(frozen=True)
class Part:
    """A part of a splat.

    Args:
        name: Its name, which no other part has.
        role: ``soft`` (it moves), ``rigid`` (it moves as one body, and what is attached to it bends there), ``held``
            (it is simulated and drawn, but stays where it is, and what is attached to it bends there), ``still`` (it is
            drawn, and the simulation does not know it) or ``hidden`` (it is taken away).
        E: Young's modulus [Pa]; that of the object if None. A rigid part has none.
        nu: Poisson's ratio; that of the object if None. A rigid part has none.
        density: Density [kg/m³]; that of the object if None.
        thickness: Thickness of the surface [m]; that of the object if None.
        damping_ratio: Damping ratio at 1 Hz; that of the object if None.
        attached: The name of the only part to which it is attached, with ``scene.connected: surface``; any if None.
        joint_stiffness: With a joint instead of its material it is attached by a spring of this stiffness [N/m]; as
            stiff as a substep allows if None and ``joint_turning`` is given.
        joint_turning: Stiffness of the joint against turning [N m/rad]; 0 for a hinge to all sides, the default if
            ``joint_stiffness`` is given.

    Raises:
        ValueError: If a value is out of range, a part that is ``still`` or ``hidden`` has a material, a ``rigid`` one E
            or nu, or one with a joint names no other.
    """

    name: str
    role: str = "soft"
    _: KW_ONLY
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    thickness: float | None = None
    damping_ratio: float | None = None
    attached: str | None = None
    joint_stiffness: float | None = None
    joint_turning: float | None = None

    def __post_init__(self) -> None:
        if not 0 < len(self.name) <= LONGEST_NAME:
            words = f"a name of {len(self.name):,} letters" if self.name else "no name"
            raise ValueError(f"A part has {words}: give it one of at most {LONGEST_NAME}.")
        check_choice(f"role of the part {self.name!r}", self.role, ROLES)
        if self.role in ("still", "hidden") and self.has_material:
            raise ValueError(
                f"The part {self.name!r} is {self.role} and has no material: remove its numbers, or its role."
            )
        if self.role == "rigid" and (self.E is not None or self.nu is not None):
            raise ValueError(
                f"The part {self.name!r} is rigid and does not bend: remove its `E` and `nu`, or its role."
            )
        for name in NUMBERS:
            value, what = getattr(self, name), f"{name} of the part {self.name!r}"
            if value is not None and name == "nu":
                check_plain(what, value)
                check_poisson_ratio(what, value)
            elif value is not None:
                check_positive(what, value, allow_zero=name == "damping_ratio")
        for name in JOINT:
            if getattr(self, name) is not None:
                check_positive(f"{name} of the part {self.name!r}", getattr(self, name), allow_zero=True)
        if self.has_joint and self.attached is None:
            raise ValueError(
                f"The part {self.name!r} has a joint to nothing: name the other part as `attached`, or remove it."
            )

    @property
    def has_joint(self) -> bool:
        return any(getattr(self, name) is not None for name in JOINT)

    @property
    def has_material(self) -> bool:
        return any(getattr(self, name) is not None for name in NUMBERS)


class Parts(Fixed):
    """The parts of a splat.

    Args:
        labels: The part of each Gaussian, as its place in ``parts``, shape (N,).
        parts: The parts.

    Raises:
        ValueError: If two parts have the same name, there are none or too many, or a label has no part.

    Example:
        >>> parts = Parts([0, 0, 1], [Part("pot", "still"), Part("plant", E=1e5)])
        >>> parts.mask(role="soft").tolist()
        [False, False, True]
    """

    def __init__(self, labels: Tensor | Sequence[int] | np.ndarray, parts: Sequence[Part]) -> None:
        self.labels = torch.as_tensor(np.asarray(labels, dtype=np.int64))
        self.parts = tuple(parts)
        check_shape("labels", self.labels, None)
        names = [part.name for part in self.parts]
        if not 0 < len(names) <= MOST:
            raise ValueError(f"Expected from 1 to {MOST:,} parts, but got {len(names):,}.")
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"Two parts have the name {twice!r}: give each a name of its own.")
        if len(self.labels) and not 0 <= int(self.labels.min()) <= int(self.labels.max()) < len(names):
            raise ValueError(
                f"Expected labels from 0 to {len(names) - 1}, one of the {len(names)} parts, but they go from "
                f"{int(self.labels.min())} to {int(self.labels.max())}."
            )

        for part in self.parts:
            if part.attached is not None and (part.attached not in names or part.attached == part.name):
                raise ValueError(
                    f"The part {part.name!r} is attached to {part.attached!r}, which is no other part: use one of "
                    f"{', '.join(repr(name) for name in names if name != part.name)}."
                )

    def attached_to(self) -> list[int | None] | None:
        """For each part the index of the only part it may attach to; None for any.

        It is the part itself where it has a joint. None if no part names another.
        """
        names = [part.name for part in self.parts]
        found = [
            None if part.attached is None else names.index(part.name if part.has_joint else part.attached)
            for part in self.parts
        ]
        return None if all(place is None for place in found) else found

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        count = torch.bincount(self.labels, minlength=len(self.parts)).tolist()
        return f"Parts({', '.join(f'{p.name} ({p.role}): {n:,}' for p, n in zip(self.parts, count, strict=True))})"

    def mask(self, name: str | None = None, role: str | None = None) -> Tensor:
        """The Gaussians of a part, or of all parts of a role, bool, shape (N,)."""
        if name is not None and name not in [part.name for part in self.parts]:
            raise ValueError(
                f"There is no part {name!r}: use one of {', '.join(repr(part.name) for part in self.parts)}."
            )
        wanted = [(name is None or p.name == name) and (role is None or p.role == role) for p in self.parts]
        return torch.tensor(wanted)[self.labels]

    def digest(self) -> str:
        content = self.labels.numpy().tobytes() + repr(self.parts).encode()
        return hashlib.sha256(content).hexdigest()

    def check_count(self, count: int) -> None:
        """Raise ValueError unless the parts are those of a splat of ``count`` Gaussians."""
        if len(self) != count:
            raise ValueError(
                f"`scene.parts` has labels of {len(self):,} Gaussians, but the splat has {count:,}: it belongs to "
                "another splat. Make the parts of this one, or leave them out."
            )

    def save(self, path: str | os.PathLike[str]) -> Path:
        small = np.uint8 if len(self.parts) <= 1 << 8 else np.uint16
        numbers: dict[str, Any] = {
            name: np.array([math.nan if getattr(p, name) is None else getattr(p, name) for p in self.parts], np.float64)
            for name in (*NUMBERS, *(name for name in JOINT if any(part.has_joint for part in self.parts)))
        }
        if self.attached_to() is not None:
            numbers["attached"] = np.array([part.attached or "" for part in self.parts])
        path = Path(path)
        with atomic(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                count=np.int64(len(self)),
                labels=self.labels.numpy().astype(small),
                names=np.array([part.name for part in self.parts]),
                roles=np.array([part.role for part in self.parts]),
                **numbers,
            )
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Parts:
        needed, more = ("count", "labels", "names", "roles"), (*NUMBERS, *JOINT, "attached")
        arrays = read_arrays(path, "the parts", needed, more, only=True)
        labels, names = arrays["labels"], arrays["names"]
        expected = {
            "count": arrays["count"].shape == () and arrays["count"].dtype.kind in "iu",
            "labels": labels.ndim == 1 and labels.dtype.kind in "iu",
            "names": names.ndim == 1 and names.dtype.kind == "U",
            "roles": arrays["roles"].shape == names.shape and arrays["roles"].dtype.kind == "U",
        }
        expected |= {
            n: arrays[n].shape == names.shape and arrays[n].dtype.kind in "fiu"
            for n in (*NUMBERS, *JOINT)
            if n in arrays
        }
        if "attached" in arrays:
            expected["attached"] = arrays["attached"].shape == names.shape and arrays["attached"].dtype.kind == "U"
        wrong = next((name for name, fits in expected.items() if not fits), None)
        if wrong is not None:
            found = f"shape {arrays[wrong].shape}, type {arrays[wrong].dtype}"
            raise ValueError(f"{path}: the array `{wrong}` has a wrong shape or type ({found}): make the parts again.")
        if len(labels) != int(arrays["count"]):
            raise ValueError(
                f"{path} is for {int(arrays['count']):,} Gaussians, but has {len(labels):,} labels: make the parts "
                "again."
            )
        values: list[dict[str, Any]] = [
            {n: float(arrays[n][k]) for n in (*NUMBERS, *JOINT) if n in arrays and not math.isnan(arrays[n][k])}
            for k in range(len(names))
        ]
        for own, other in zip(values, arrays.get("attached", ()), strict=False):
            own.update({"attached": str(other)} if other else {})
        try:
            parts = [Part(str(n), str(r), **v) for n, r, v in zip(names, arrays["roles"], values, strict=True)]
            return cls(labels, parts)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


class PartRegion(Region):
    """All of space that is closer to the Gaussians of a part than to the others.

    Args:
        name: Name of the part, for messages.
        means: Centres of the Gaussians [scene units], shape (N, 3).
        members: Which of them are of the part, bool, shape (N,).
    """

    def __init__(self, name: str, means: Tensor, members: Tensor) -> None:
        check_shape("means", means, None, 3)
        check_shape("members", members, len(means))
        self.name, self.means, self.members = name, means.detach().cpu().double(), members.cpu()
        self._tree: cKDTree | None = None

    def __repr__(self) -> str:
        return f"of the part {self.name!r}"

    def __getstate__(self) -> dict[str, object]:
        return super().__getstate__() | {"_tree": None}

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are closest to a Gaussian of the part."""
        from scipy.spatial import cKDTree

        check_shape("points", points, 3)
        if points.shape == self.means.shape and bool((points.detach().cpu().double() == self.means).all()):
            return self.members.to(points.device)  # the Gaussians themselves, of which several may be at one place
        if self._tree is None:
            self._tree = cKDTree(self.means.numpy())
        index = self._tree.query(points.detach().cpu().double().reshape(-1, 3).numpy())[1]
        return self.members[torch.from_numpy(index)].reshape(points.shape[:-1]).to(points.device)
