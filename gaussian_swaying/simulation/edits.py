"""Changes of material or colour for a part of the object, at load or during a run."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_plain, check_positive, check_vector
from gaussian_swaying._fixed import fixed
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.regions import Region, whereabouts
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.state import MaterialPoints, State
from gaussian_swaying.simulation.parameters import parameter
from gaussian_swaying.simulation.stepper import Stepper

LUMINANCE = (0.2126, 0.7152, 0.0722)  # ITU-R BT.709


@fixed
@dataclass
class Edit:
    """A change to a part of the object.

    Deformations and velocities stay as they are; stresses follow the new material from then on. Where the law changes,
    its internal variable is reset. The thickness cannot be edited: the points of the material, their layers and the
    contact samples depend on it.

    Args:
        region: Region at rest, in scene units; it may also contain Gaussians that do not move. Everything that moves if
            null.
        time: Time [s]: the edit applies from the first frame at or after it. 0 means at load.
        E: Young's modulus [Pa]; unchanged if null.
        nu: Poisson's ratio; unchanged if null.
        density: Density at rest [kg/m³]; unchanged if null.
        law: Constitutive law; unchanged if null. A plastic law needs ``solver.formulation: updated``.
        color: Red, green and blue in [0, 1], the same from every direction; unchanged if null.
        detail: Fraction of the brightness differences within the region that the new colour keeps, in [0, 1].
    """

    region: Region | None = None
    time: float = 0.0
    _: KW_ONLY
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    law: ConstitutiveLaw | None = None
    color: list[float] | None = None
    detail: float = 0.0

    def __post_init__(self) -> None:
        check_positive("edits.time", self.time, allow_zero=True)
        for name in ("E", "nu", "density"):
            if getattr(self, name) is not None:
                check_plain(f"edits.{name}", getattr(self, name))
                parameter(f"material.{name}").check(getattr(self, name), f"edits.{name}")
        if self.color is not None and not all(0 <= part <= 1 for part in check_vector("edits.color", self.color)):
            raise ValueError(f"Expected `edits.color` to lie in [0, 1], but got {self.color}.")
        if not 0 <= self.detail <= 1:
            raise ValueError(f"Expected `edits.detail` to lie in [0, 1], but got {self.detail}.")
        if not self.of_material and self.color is None:
            raise ValueError("An entry of `edits` changes nothing: give `E`, `nu`, `density`, `law` or `color`.")

    @property
    def of_material(self) -> bool:
        """True if more than the colour changes."""
        return any(value is not None for value in (self.E, self.nu, self.density, self.law))


def edited_points(points: MaterialPoints, inside: Tensor, edit: Edit, flowed: bool = False) -> MaterialPoints:
    """Apply an edit to the material.

    Args:
        points: The material of one scene, shapes (P, ·).
        inside: Which points are edited, bool, shape (P,).
        edit: The change.
        flowed: Whether the points have already moved. After plastic flow, the elastic and the total deformation differ
            for good. If no plastic law is left, one of the other laws is set to keep both, and the plastic law stays in
            the list without particles, because the kernels check the list.

    Returns:
        The material; laws that no point uses any more are left out.
    """

    def field(value: float | None, old: Tensor) -> Tensor:
        return old if value is None else torch.where(inside, value, old)

    before = torch.zeros_like(inside, dtype=torch.long) if points.law_index is None else points.law_index
    index, laws = before, list(points.laws)
    if edit.law is not None:
        index = torch.where(inside, len(laws), before)
        laws.append(edit.law)
    used = torch.unique(index).tolist()
    kept = [laws[k] for k in used]
    had_both = flowed and any(laws[k].plastic for k in torch.unique(before).tolist())
    if had_both and not any(type(law).plastic for law in kept):
        kept[0] = copy.deepcopy(kept[0])
        kept[0].plastic = True
        kept.append(next(law for law in laws if type(law).plastic))
    place = torch.zeros(len(laws), dtype=torch.long, device=index.device)
    place[used] = torch.arange(len(used), device=index.device)
    bending = points.bending
    if bending is not None and edit.E is not None:
        bending = torch.where(inside, bending * edit.E / points.youngs_modulus, bending)
    mass = points.mass if edit.density is None else torch.where(inside, edit.density * points.volume, points.mass)
    return dataclasses.replace(
        points,
        mass=mass,
        youngs_modulus=field(edit.E, points.youngs_modulus),
        bending=bending,
        poisson_ratio=field(edit.nu, points.poisson_ratio),
        laws=tuple(kept),
        law_index=place[index] if len(kept) > 1 else None,
    )


def recolored(sh: Tensor, inside: Tensor, color: Sequence[float], detail: float = 0.0) -> Tensor:
    """Spherical harmonics of a splat, with one colour for a part of it.

    Args:
        sh: Coefficients, shape (N, K, 3).
        inside: Which Gaussians get the colour, bool, shape (N,).
        color: Red, green and blue in [0, 1].
        detail: Fraction of the brightness differences that is kept: the colour is multiplied by ``1 + detail (Y /
            mean(Y) - 1)`` with the luminance Y of the old colours.

    Returns:
        Shape (N, K, 3).
    """
    old = (sh[:, 0] * SH_DC + 0.5).clamp_min(0)
    luminance = (old * old.new_tensor(LUMINANCE)).sum(-1)
    mean = torch.where(inside, luminance, 0.0).sum() / inside.sum().clamp_min(1)
    factor = 1 + detail * (luminance / mean.clamp_min(1e-6) - 1)
    new = torch.zeros_like(sh)
    new[:, 0] = (factor[:, None] * old.new_tensor(list(color)) - 0.5) / SH_DC
    return torch.where(inside[:, None, None], new, sh)


class SceneEditor:
    """Applies edits to the scene of a stepper, in order of their times, and can undo them.

    Args:
        stepper: The stepper; its scene and material are changed.
        edits: The edits. Those with the same time are applied in the given order, so that later entries win.

    Raises:
        ValueError: If the region of an edit contains nothing that it could change.
    """

    def __init__(self, stepper: Stepper, edits: Sequence[Edit] = ()) -> None:
        self.stepper, self.scene = stepper, stepper.scene
        self.edits = sorted(edits, key=lambda edit: edit.time)
        self.applied = 0
        self.version = 0  # counts the changes of colour
        self._loaded: tuple[MaterialPoints, Tensor, Tensor] | None = None
        for edit in self.edits:
            self.reach(edit)

    # ---- with the stepper

    def start(self) -> State:
        """The state at rest at time zero, with the edits of that time applied."""
        self.reset()
        for later in (moment for moment in self.times if moment > 0):  # refuse impossible edits now
            self._apply_all(self.due(0.0))
            self._apply_all(self.due(later), flowed=True)
            self._pass_on()
            self.stepper.rehearse()
        self.reset()
        self._apply_all(self.due(0.0))
        self._pass_on()
        return self.stepper.start()

    def edit(self, state: State, edits: Sequence[Edit]) -> State:
        """Apply edits now, whatever their time; if one is not possible, nothing changes.

        Args:
            state: The state now.
            edits: The changes, in this order.

        Returns:
            The state from which the run continues.
        """
        before = self.snapshot()
        try:
            return self._go_on(state, edits)
        except Exception:
            self.restore(before)
            self._pass_on()
            self.stepper.bind()
            raise

    def edit_due(self, state: State, resumed: bool = False) -> State:
        """Apply the edits up to the time of a state; a resumed state contains them already."""
        if not self.edits:  # the host need not wait for the time
            return state
        edits = self.due(float(state.time) + 1e-3 * self.stepper.frame_dt)
        edited = self._go_on(state, edits)
        return state if resumed else edited

    def _go_on(self, state: State, edits: Sequence[Edit]) -> State:
        """Apply edits; the internal variable of particles that get another law starts anew."""
        changed = self._apply_all(edits, flowed=True)
        rest = self._pass_on(running=True)
        if rest is None:
            return state
        start = rest.internal
        if start is not None and state.internal is not None:
            start = state.internal if changed is None else torch.where(changed, start, state.internal)
        return state.replace(internal=start)

    def _apply_all(self, edits: Sequence[Edit], flowed: bool = False) -> Tensor | None:
        """Change the scene; returns which particles (P,) got another law, None if the material is the same."""
        changed = [self.apply(edit, flowed) for edit in edits]
        changed = [part for part, edit in zip(changed, edits, strict=True) if edit.of_material]
        return torch.stack(changed).any(0) if changed else None

    def _pass_on(self, running: bool = False) -> State | None:
        """Give the material of the scene to the stepper."""
        return self.stepper.take(dataclasses.replace(self.stepper.setup, points=self.scene.points), running)

    # ---- the scene

    def snapshot(self) -> tuple[MaterialPoints, nn.Parameter, nn.Parameter, int]:
        """The scene as it is now, for :meth:`restore`."""
        model = self.scene.model
        return self.scene.points, model.sh0, model.shN, self.version

    def restore(self, snapshot: tuple[MaterialPoints, nn.Parameter, nn.Parameter, int]) -> None:
        """Put the scene back to what it was at a :meth:`snapshot`."""
        self.scene.points, self.scene.model.sh0, self.scene.model.shN, self.version = snapshot

    @property
    def times(self) -> list[float]:
        return sorted({edit.time for edit in self.edits})

    def reach(self, edit: Edit) -> tuple[Tensor, Tensor]:
        """Return masks of the particles (P,) and of the Gaussians (N,) that an edit changes."""
        scene, region, means = self.scene, edit.region, self.scene.model.means.detach()
        given = (scene.points.youngs_modulus, scene.points.poisson_ratio, scene.points.mass)
        if edit.of_material and any(value.requires_grad for value in given):
            raise ValueError(
                "`edits` of the material would lose the gradient of `material`: leave them out, or give the material "
                "without a gradient."
            )
        if region is None:
            particles = torch.ones_like(scene.points.mass, dtype=torch.bool)
            gaussians = torch.zeros_like(means[:, 0], dtype=torch.bool).index_fill(0, scene.moving, True)
        else:
            particles = region.contains(scene.frame.point_to_scene(scene.points.position).to(means.dtype))
            gaussians = region.contains(means)
        particles, gaussians = particles & edit.of_material, gaussians & (edit.color is not None)
        for wanted, found, what in (
            (edit.of_material, particles, "simulated Gaussian"),
            (edit.color is not None, gaussians, "Gaussian"),
        ):
            if region is not None and wanted and not bool(found.any()):
                between, hint = whereabouts(region, means[scene.moving], scene.frame.rotation)
                raise ValueError(
                    f"The region {region!r} of `edits` at {edit.time:g} s holds no {what}: those that move lie "
                    f"{between}; {hint or 'move or enlarge it'}."
                )
        return particles, gaussians

    def rebase(self, points: MaterialPoints) -> None:
        """Set the material that the scene has before its edits, for :meth:`reset`."""
        if self._loaded is not None:
            self._loaded = (points, *self._loaded[1:])

    @property
    def unedited(self) -> tuple[MaterialPoints, Tensor, Tensor]:
        """Material and colours (harmonics of degree 0, and of the others) without the edits."""
        model = self.scene.model
        return self._loaded or (self.scene.points, model.sh0.detach(), model.shN.detach())

    def reset(self) -> None:
        """Restore the scene as it was before its first edit."""
        self.applied = 0
        if self._loaded is None:
            return
        device = self.scene.model.means.device
        points, sh0, shN = self._loaded
        self.scene.points = points.map(lambda tensor: tensor.to(device))
        self._paint(sh0.to(device), shN.to(device))
        self._loaded = None

    def due(self, time: float) -> list[Edit]:
        """Return the edits up to a time [s] that were not yet applied, and mark them as applied."""
        found = [edit for edit in self.edits[self.applied :] if edit.time <= time]
        self.applied += len(found)
        return found

    def apply(self, edit: Edit, flowed: bool = False) -> Tensor:
        """Apply an edit to the scene.

        Args:
            edit: The change.
            flowed: See :func:`edited_points`.

        Returns:
            Which particles have another law now, bool, shape (P,).
        """
        particles, gaussians = self.reach(edit)
        model = self.scene.model
        if self._loaded is None:
            self._loaded = self.unedited
        with torch.inference_mode(False), torch.no_grad():
            if edit.of_material:
                self.scene.points = edited_points(self.scene.points, particles, edit, flowed)
            if edit.color is not None:
                sh = recolored(model.sh.detach(), gaussians, edit.color, edit.detail)
                self._paint(sh[:, :1], sh[:, 1:])
        return particles & (edit.law is not None)

    def _paint(self, sh0: Tensor, shN: Tensor) -> None:
        self.version += 1
        with torch.inference_mode(False):
            self.scene.model.sh0 = nn.Parameter(sh0.clone(), requires_grad=False)
            self.scene.model.shN = nn.Parameter(shN.clone(), requires_grad=False)
