"""Copying, splitting, moving and removing Gaussians during training: gsplat's strategies behind one interface."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cache
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.gaussians.subdivision import split_large
from gaussian_swaying.rendering.protocol import ScreenGaussians
from gaussian_swaying.training.parallel import steps_of, sum_over_devices, this_device

PARAMETERS = ("means", "scales", "quats", "opacities", "sh0", "shN")
"""Parameters of a :class:`GaussianSurfaceModel`; those of an optimiser come in this order."""

_SUMS = ("grad2d", "count")  # of gsplat's state, over the images since the last change

_IN_IMAGES = ("refine_start_iter", "refine_stop_iter", "refine_every", "reset_every")


def _check_steps(**values: int) -> None:
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise ValueError(f"Expected `densification.{name}` to be a number of steps, but got {value!r}.")


class Densification(ABC):
    """Keeps parameters, optimiser and the state of a strategy consistent when Gaussians are added or removed.

    Order of calls: :meth:`attach` once, then for each image :meth:`before_backward`, the backward pass, the step of
    the optimiser, and :meth:`after_step`. Steps count images from 0.
    """

    def __init__(self) -> None:
        self._model: GaussianSurfaceModel | None = None
        self._optimizers: dict[str, Any] = {}
        self._strategy: Any = None
        self._state: dict[str, Any] = {}
        self._restored: dict[str, Any] | None = None
        self.devices = 1

    @abstractmethod
    def make_strategy(self, device: torch.device) -> Any:
        """The strategy of gsplat for parameters on a device; ValueError if it does not run there."""

    def attach(
        self,
        model: GaussianSurfaceModel,
        optimizer: torch.optim.Optimizer,
        scene_scale: float,
        devices: int = 1,
    ) -> None:
        """Use a model and its optimiser from now on.

        Args:
            optimizer: Its optimiser, with a group for each of :data:`PARAMETERS`, in this order.
            scene_scale: Extent of the scene [scene units]; size thresholds are shares of it.
        """
        check_positive("scene_scale", scene_scale)
        groups = optimizer.param_groups
        if [[id(item) for item in group["params"]] for group in groups] != [
            [id(getattr(model, n))] for n in PARAMETERS
        ]:
            raise ValueError(f"Expected an optimiser with one group for each of {', '.join(PARAMETERS)} of the model.")
        device, self.devices = model.means.device, devices
        self._strategy = self.make_strategy(device)
        self._model = model
        # to gsplat's strategies each group looks like an optimiser of one parameter
        self._optimizers = {
            name: SimpleNamespace(param_groups=[group], state=optimizer.state)
            for name, group in zip(PARAMETERS, groups, strict=True)
        }
        self._state = self._initial_state(scene_scale)
        if self._restored is not None:
            moved = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in self._restored.items()}
            self._state |= moved
            if this_device()[0] > 0:  # the first device goes on with the sums of all
                self._state |= {name: torch.zeros_like(moved[name]) for name in _SUMS if moved.get(name) is not None}
            self._restored = None

    def _initial_state(self, scene_scale: float) -> dict[str, Any]:
        return dict(self._strategy.initialize_state())

    def before_backward(self, step: int, screen: ScreenGaussians) -> None:
        if screen.means2d.requires_grad:
            screen.means2d.retain_grad()

    def after_step(self, step: int, screen: ScreenGaussians) -> None:
        """Change the Gaussians as the strategy decides, after the step of the optimiser."""
        assert self._model is not None, "attach comes first"
        parameters = {name: getattr(self._model, name) for name in PARAMETERS}
        self._advance(parameters, step, screen)
        for name, parameter in parameters.items():
            if parameter is not getattr(self._model, name):
                setattr(self._model, name, parameter)

    @abstractmethod
    def _advance(self, parameters: dict[str, nn.Parameter], step: int, screen: ScreenGaussians) -> None:
        """Run the strategy; it puts new parameters into the dictionary."""

    def state_dict(self) -> dict[str, Any]:
        """Everything accumulated by the strategy since it last changed the Gaussians, on all devices."""
        sums = {name: self._state[name].clone() for name in _SUMS if self._state.get(name) is not None}
        sum_over_devices(list(sums.values()))
        return self._state | sums

    def _in_steps(self, options: dict[str, Any]) -> dict[str, Any]:
        return {k: steps_of(v, self.devices) if k in _IN_IMAGES else v for k, v in options.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._restored = dict(state)


class DefaultDensification(Densification):
    """Copy, split and prune by the gradient on the screen: gsplat's ``DefaultStrategy`` (Kerbl et al. 2023).

    Works on any device. gsplat 1.5.3 never resets opacities, as its condition is never true.

    Args:
        start: Step after which Gaussians may change.
        stop: Step from which they no longer do.
        every: Steps between changes.
        grow_grad2d: Gradient on the screen (in units of half the picture) above which a Gaussian is copied or split.
        grow_scale3d: Scale above which it is split rather than copied, as a share of the scene's extent.
        prune_opacity: Opacity below which it is removed.
        prune_scale3d: Scale above which it is removed after ``reset_every``, as a share of the scene's extent.
        reset_every: Steps after which large Gaussians are pruned.
        split_at: Step at which all large Gaussians are split, at ``stop`` or later (see
            :func:`~gaussian_swaying.gaussians.subdivision.split_large`); null for never. On a surface of one colour
            nothing else makes Gaussians small, and large ones blur the folds of moving cloth.
        split_size: Largest standard deviation of the resulting Gaussians [scene units], and of all Gaussians from then
            on. From then on rotations are also fixed: the tilt of a small Gaussian is not visible, so training would
            turn it away from the correct normal of the large one by several degrees, and wind acts on normals.

    Raises:
        ValueError: If an argument is negative, ``every`` or ``reset_every`` is 0, or ``split_at`` is before ``stop``.
    """

    def __init__(
        self,
        start: int = 500,
        stop: int = 15_000,
        every: int = 100,
        grow_grad2d: float = 0.0002,
        grow_scale3d: float = 0.01,
        prune_opacity: float = 0.005,
        prune_scale3d: float = 0.1,
        reset_every: int = 3000,
        split_at: int | None = None,
        split_size: float = 0.008,
    ) -> None:
        super().__init__()
        _check_steps(start=start, stop=stop, every=every, reset_every=reset_every)
        check_positive("densification.split_size", split_size)
        if split_at is not None:
            _check_steps(split_at=split_at)
            if split_at < stop:
                raise ValueError(
                    f"Expected `densification.split_at` at `densification.stop` ({stop}) or later, but got {split_at}."
                )
        self.split_at, self.split_size = split_at, float(split_size)
        for name, value in (("every", every), ("reset_every", reset_every), ("grow_grad2d", grow_grad2d)):
            check_positive(f"densification.{name}", value)
        for name, value in (("grow_scale3d", grow_scale3d), ("prune_scale3d", prune_scale3d)):
            check_positive(f"densification.{name}", value)
        if not 0.0 <= prune_opacity < 0.5:
            raise ValueError(f"Expected `densification.prune_opacity` from 0 to below 0.5, but got {prune_opacity}.")
        self.stop = stop
        self._options: dict[str, Any] = {
            "refine_start_iter": start,
            "refine_stop_iter": stop,
            "refine_every": every,
            "grow_grad2d": grow_grad2d,
            "grow_scale3d": grow_scale3d,
            "prune_opa": prune_opacity,
            "prune_scale3d": prune_scale3d,
            "reset_every": reset_every,
        }

    def make_strategy(self, device: torch.device) -> Any:
        return _default_strategy()(**self._in_steps(self._options))

    def _initial_state(self, scene_scale: float) -> dict[str, Any]:
        return dict(self._strategy.initialize_state(scene_scale=scene_scale))

    def before_backward(self, step: int, screen: ScreenGaussians) -> None:
        if step < steps_of(self.stop, self.devices):
            super().before_backward(step, screen)

    def after_step(self, step: int, screen: ScreenGaussians) -> None:
        split_at = None if self.split_at is None else steps_of(self.split_at, self.devices)
        if step == split_at:
            self._split_large()
        if split_at is not None and step >= split_at:  # or they would grow again
            assert self._model is not None, "attach comes first"
            with torch.no_grad():
                self._model.scales.clamp_(max=math.log(self.split_size))
        if step >= steps_of(self.stop, self.devices):
            return
        if screen.means2d.grad is None:  # nothing was drawn
            screen.means2d.grad = torch.zeros_like(screen.means2d)
        super().after_step(step, screen)

    @torch.no_grad()
    def _split_large(self) -> None:
        model = self._model
        assert model is not None, "attach comes first"
        found = split_large(model.means, model.quats, model.scales, model.opacity(), self.split_size)
        old = len(model)
        opacities = torch.cat([model.opacities, torch.logit(found.opacity[old:], 1e-6)])
        new = {"means": found.means, "scales": found.log_scales, "opacities": opacities}
        for name in PARAMETERS:
            before = getattr(model, name)
            values = new.get(name, before.detach()[found.source])
            parameter = nn.Parameter(values.contiguous(), requires_grad=before.requires_grad)
            optimizer = self._optimizers[name]
            kept = optimizer.state.pop(before, {})
            # old Gaussians keep their momenta, new ones start with zero
            room = {k: v.new_zeros(len(values) - old, *v.shape[1:]) for k, v in kept.items() if _is_per_row(v, old)}
            optimizer.state[parameter] = kept | {k: torch.cat([kept[k], zeros]) for k, zeros in room.items()}
            optimizer.param_groups[0]["params"] = [parameter]
            setattr(model, name, parameter)
        self._optimizers["quats"].param_groups[0]["lr"] = 0.0

    def _advance(self, parameters: dict[str, nn.Parameter], step: int, screen: ScreenGaussians) -> None:
        self._strategy.step_post_backward(
            parameters, self._optimizers, self._state, step, screen.info(), packed=screen.index is not None
        )


@cache
def _default_strategy() -> type:
    """The ``DefaultStrategy`` of gsplat, without the waits for the GPU in its sums of gradients.

    On several devices each sums over its own images; they decide by the sums over all, which are the same on all.
    """
    from gsplat import DefaultStrategy

    class Strategy(DefaultStrategy):
        def _grow_gs(self, params: Any, optimizers: Any, state: dict[str, Any], step: int) -> tuple[int, int]:
            sum_over_devices([state[name] for name in _SUMS])
            grown: tuple[int, int] = super()._grow_gs(params, optimizers, state, step)
            return grown

        def _update_state(self, params: Any, state: dict[str, Any], info: dict[str, Any], packed: bool = False) -> None:
            if packed or state["grad2d"] is None or self.refine_scale2d_stop_iter > 0:
                super()._update_state(params, state, info, packed)
                return
            means2d = info[self.key_for_gradient]
            grads = means2d.grad.clone()
            grads[..., 0] *= info["width"] / 2.0 * info["n_cameras"]
            grads[..., 1] *= info["height"] / 2.0 * info["n_cameras"]
            seen = (info["radii"] > 0.0).all(dim=-1)  # as a mask: a list of indices would have to reach the host
            state["grad2d"] += torch.where(seen, grads.norm(dim=-1), 0.0).sum(0)
            state["count"] += seen.sum(0)

    return Strategy


def _is_per_row(value: Any, rows: int) -> bool:
    return isinstance(value, Tensor) and value.ndim > 0 and len(value) == rows


class MCMCDensification(Densification):
    """Move faint Gaussians to opaque ones and add noise: gsplat's ``MCMCStrategy`` (Kheradmand et al. 2024). CUDA only.

    The losses must include penalties on opacity and scale, with a weight of 0.01 each:
    :class:`~gaussian_swaying.training.losses.MeanOpacityLoss` and
    :class:`~gaussian_swaying.training.losses.MeanScaleLoss`.

    Args:
        cap: Largest number of Gaussians.
        start: Step after which Gaussians may move.
        stop: Step from which they no longer do.
        every: Steps between moves.

    Raises:
        ValueError: If an argument is negative, or ``cap`` or ``every`` is 0.
    """

    def __init__(
        self,
        cap: int = 1_000_000,
        start: int = 500,
        stop: int = 25_000,
        every: int = 100,
    ) -> None:
        super().__init__()
        _check_steps(start=start, stop=stop, every=every)
        check_positive("densification.cap", cap)
        check_positive("densification.every", every)
        self._options: dict[str, Any] = {
            "cap_max": cap,
            "refine_start_iter": start,
            "refine_stop_iter": stop,
            "refine_every": every,
        }

    def make_strategy(self, device: torch.device) -> Any:
        """``gsplat.MCMCStrategy`` with these options; ValueError on anything but CUDA."""
        if device.type != "cuda":
            raise ValueError(
                f"MCMCDensification needs CUDA, as gsplat moves Gaussians in a kernel, but the model is on {device}: "
                "use DefaultDensification there."
            )
        from gsplat import MCMCStrategy

        return MCMCStrategy(**self._in_steps(self._options))

    def before_backward(self, step: int, screen: ScreenGaussians) -> None:
        """Nothing to prepare: gradients on the screen are not used."""

    def _advance(self, parameters: dict[str, nn.Parameter], step: int, screen: ScreenGaussians) -> None:
        rate = float(self._optimizers["means"].param_groups[0]["lr"])
        with torch.no_grad():
            self._strategy.step_post_backward(parameters, self._optimizers, self._state, step, screen.info(), lr=rate)

    def state_dict(self) -> dict[str, Any]:
        return {}
