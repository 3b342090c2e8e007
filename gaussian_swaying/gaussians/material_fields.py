"""Materials that differ from Gaussian to Gaussian, as networks predict them."""

from __future__ import annotations

import os
import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._fixed import Fixed
from gaussian_swaying._inputs import read_arrays
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.parts import NUMBERS
from gaussian_swaying.geometry.groups import joined
from gaussian_swaying.geometry.neighbours import nearest_neighbours

_OF_VOMP = {"youngs_modulus": "E", "poissons_ratio": "nu", "density": "density"}
_APART = 3.0  # spacings of places between two rigid bodies


@dataclass(frozen=True)
class MaterialField:
    """Numbers of a material at places; those of the nearest place count. NaN keeps the number of the object.

    Attributes:
        places: The places, in scene units, shape (M, 3).
        E: Young's moduli [Pa], shape (M,); None to keep all of the object, here and below.
        nu: Poisson's ratios, shape (M,).
        density: Densities [kg/m³], shape (M,).
        thickness: Thicknesses of the surface [m], shape (M,).
        damping_ratio: Damping ratios at 1 Hz, shape (M,).
        rigid: Which are part of a rigid body, bool, shape (M,).

    Raises:
        ValueError: If a number has no meaning; the message names the field.
    """

    places: Tensor
    E: Tensor | None = None
    nu: Tensor | None = None
    density: Tensor | None = None
    thickness: Tensor | None = None
    damping_ratio: Tensor | None = None
    rigid: Tensor | None = None

    def __post_init__(self) -> None:
        if not len(self.places) or not bool(torch.isfinite(self.places).all()):
            raise ValueError("Expected `scene.materials` to have one finite place or more: leave out the others.")
        for name in NUMBERS:
            values = getattr(self, name)
            if values is None:
                continue
            if values.shape != self.places.shape[:1]:
                raise ValueError(
                    f"Expected `{name}` of `scene.materials` to have a number for each of {len(self.places):,} places, "
                    f"but its shape is {tuple(values.shape)}."
                )
            low, high = (-1.0, 0.5) if name == "nu" else (0.0, torch.inf)
            wrong = (values <= low if name != "damping_ratio" else values < low) | (values >= high)
            if bool(wrong.any()):
                raise ValueError(
                    f"Expected `{name}` of `scene.materials` to lie between {low:g} and {high:g}, but "
                    f"{int(wrong.sum()):,} of {len(values):,} do not, such as {float(values[wrong][0]):g}: give NaN "
                    "where the number of `material` is to stay."
                )

    def at(self, points: Tensor) -> dict[str, Tensor]:
        """The numbers at points (N, 3) in scene units, by name, float64, shape (N,)."""
        near = nearest_neighbours(self.places, 1, points)[1][:, 0]
        known = {name: getattr(self, name) for name in NUMBERS}
        return {name: values.double()[near].to(points.device) for name, values in known.items() if values is not None}

    def rigid_bodies(self, means: Tensor) -> list[Tensor]:
        """Which of some Gaussians (N, 3) each rigid body holds: masks (N,); bodies lie apart from each other."""
        if self.rigid is None or not bool(self.rigid.any()):
            return []
        from scipy.spatial import cKDTree

        mask = self.rigid[nearest_neighbours(self.places, 1, means)[1][:, 0]]
        inside = means[mask].detach().cpu().double()
        if len(inside) < 2:
            return [mask] if len(inside) else []
        spacing = float(nearest_neighbours(inside, 1)[0].median())
        pairs = cKDTree(inside.numpy()).query_pairs(_APART * max(spacing, 1e-12), output_type="ndarray")
        number = joined(len(inside), torch.from_numpy(pairs.T))
        index = mask.nonzero()[:, 0]
        return [torch.zeros_like(mask).index_fill(0, index[number == k], True) for k in range(int(number.max()) + 1)]


class MaterialSource(Fixed, ABC):
    """Gives each Gaussian a material: the base of classes that a YAML names as ``scene.materials``."""

    @abstractmethod
    def __call__(self, cloud: GaussianCloud) -> MaterialField:
        """The material of a splat, of all its Gaussians."""


class MaterialFile(MaterialSource):
    """Materials in an .npz file, one for each Gaussian or at places of their own.

    The file has any of the arrays ``E`` [Pa], ``nu``, ``density`` [kg/m³], ``thickness`` [m] and ``damping_ratio``, and
    ``places`` in scene units, shape (M, 3), unless there is one number for each Gaussian, in the order of the splat. A
    file of VoMP (Dagli et al. 2025), which has all in the array ``voxel_data``, is read as well.

    Args:
        path: The file.
        max_E: Largest Young's modulus [Pa]; what is stiffer becomes as stiff, as it would need short substeps. Null for
            no limit.
        rigid_E: Young's modulus [Pa] from which on Gaussians that lie together become a rigid body, in ``total``; null
            for none.

    Raises:
        ValueError: If the file cannot be read, or has other numbers than the splat.
    """

    def __init__(self, path: str | os.PathLike[str], max_E: float | None = None, rigid_E: float | None = None) -> None:
        for name, value in (("max_E", max_E), ("rigid_E", rigid_E)):
            if value is not None:
                check_positive(f"scene.materials.{name}", value)
        self.path, self.max_E, self.rigid_E = os.fspath(path), max_E, rigid_E

    def __call__(self, cloud: GaussianCloud) -> MaterialField:
        """See :class:`MaterialSource`."""
        found = read_arrays(self.path, "the materials", (), ("places", "voxel_data", *NUMBERS))
        whole = found.pop("voxel_data", None)
        if whole is not None:
            missing = {"x", "y", "z", *_OF_VOMP} - set(whole.dtype.names or ())
            if missing:
                raise ValueError(f"{self.path} has `voxel_data` without `{min(missing)}`: make the materials again.")
            found = {name: whole[theirs] for theirs, name in _OF_VOMP.items()}
            found["places"] = np.stack([whole[axis] for axis in "xyz"], -1)
        try:
            arrays = {name: torch.from_numpy(array.astype(np.float64)) for name, array in found.items()}
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self.path} holds what is not numbers ({error}): make the materials again.") from error
        places = arrays.pop("places", None)
        if not arrays:
            raise ValueError(f"{self.path} has none of the arrays {', '.join(NUMBERS)}: give one of them.")
        if places is None:
            places, count = cloud.means.detach().cpu().double(), len(next(iter(arrays.values())).reshape(-1))
            if count != len(places):
                raise ValueError(
                    f"{self.path} has {count:,} materials, but the splat has {len(places):,} Gaussians: use the splat "
                    "that they were made for, or add their `places` (M, 3) in scene units."
                )
        field = MaterialField(places.reshape(-1, 3), **arrays)
        stiffness = field.E
        if stiffness is None:
            return field
        rigid = None if self.rigid_E is None else stiffness >= self.rigid_E
        if self.max_E is not None:
            high = stiffness > self.max_E if rigid is None else (stiffness > self.max_E) & ~rigid
            if bool(high.any()):
                warnings.warn(
                    f"E of {int(high.sum()):,} of {len(high):,} materials in {self.path} is above `max_E` and becomes "
                    f"{self.max_E:g} Pa: up to {float(stiffness[high].max()) / self.max_E:.3g} times too soft.",
                    UserWarning,
                    stacklevel=2,
                )
            stiffness = torch.where(stiffness > self.max_E, self.max_E, stiffness)
        if rigid is not None:  # a rigid body has none, and would need shorter substeps
            stiffness = torch.where(rigid, torch.nan, stiffness)
        return replace(field, E=stiffness, rigid=rigid)
