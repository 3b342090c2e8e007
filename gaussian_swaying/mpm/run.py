"""Runs substeps with the Triton kernels: buffers, forces, CUDA graphs.

``MPMSolver`` uses it instead of the torch substep of a formulation if no gradient is needed; the torch substep is the
reference. Each formulation has a subclass of :class:`Run`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from gaussian_swaying.kernels.graphs import Repeater, recorded_key
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.kernels.launch import MAX_INDEX, call, compiles, lanes, launch
from gaussian_swaying.mpm import shared_kernels as kernels
from gaussian_swaying.mpm.device_functions import DeviceFunction, Packed
from gaussian_swaying.mpm.dispatch import BodyLaws, in_common
from gaussian_swaying.mpm.forces import MOST_STEPS, Force, added, divide, split, tensors_of
from gaussian_swaying.mpm.formulation import Formulation
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import kick_time

MAX_STEPS = MOST_STEPS
"""Number of substeps whose schedule fits in the buffers; longer rollouts are run in parts."""


@dataclass(frozen=True)
class Part:
    """A part of a rollout whose schedule fits in the buffers.

    Attributes:
        steps: Number of substeps.
        options: Constants of the kernels.
        looks: Numbers of the substeps after which the wave speed is measured.
        loaded: Whether the work of a load is counted.
        key: Key of the data that ``begin`` reads; None if it cannot be recorded.
    """

    steps: int
    options: dict[str, Any]
    looks: list[int]
    loaded: bool
    key: tuple[object, ...] | None


class Run(ABC):
    """Substeps of a formulation bound to its material.

    Args:
        bound: The formulation; it must be supported, see :meth:`unsupported`.

    Attributes:
        fixed_order: Whether sums have the same order in every run on a GPU; on a CPU they always do.
    """

    fixed_order: ClassVar[bool]

    def __init__(self, bound: Formulation) -> None:
        points = bound.points
        self.settings = bound.settings
        self.bound, self.device = bound, points.position.device
        self.particles = points.count
        self.count = points.mass.numel()
        self.scenes = self.count // max(self.particles, 1)
        self.laws = BodyLaws(points.laws)
        self.like: dict[str, Any] = {"dtype": points.position.dtype, "device": self.device}
        """Options of buffers of real numbers."""
        self.law_table = torch.tensor(self.laws.table, **self.like)
        self.law = torch.zeros(self.count, dtype=torch.int32, device=self.device)
        if points.law_index is not None:
            self.law = points.law_index.reshape(-1).int()
        self.first_step = torch.zeros(1, dtype=torch.int32, device=self.device)
        self.schedule = torch.zeros(MAX_STEPS + 2, kernels.SCHEDULE, **self.like)
        self.loads = Packed(points.mass.shape, self.like)
        """The forces of the current rollout that the kernels compute."""
        self.load = torch.zeros(8, self.count, **self.like)
        self.force_in = torch.zeros(0, 4, **self.like)
        self.wave = in_common(points.laws, "wave")
        self.watches = self.wave is not None
        """True if rollouts can measure the wave speed."""
        self.speed = torch.zeros(1, **self.like)
        self.impulse = bound.no_impulse()
        """Reaction impulse: momentum that each boundary took in the current part of the rollout, shape (..., B, 3)."""
        self.time = torch.zeros((), dtype=torch.float64, device=self.device)
        self.dt = torch.zeros((), dtype=torch.float64, device=self.device)
        self.gravity = [float(g) for g in bound.settings.gravity]
        self.asked: tuple[Force, ...] = ()
        """The forces of the current rollout that are computed in torch, in every substep."""
        self._resist: tuple[object, bool] = ((), False)
        self._seen: dict[str, Tensor] = {}
        self.repeater = Repeater(self.device, kept=8)

    @classmethod
    def unsupported(cls, bound: Formulation, interpret: bool) -> str | None:
        """Return the reason why these kernels cannot run a body, or None if they can.

        Args:
            interpret: Whether Triton's interpreter, if it is on, may run them on a CPU.
        """
        points = bound.points
        device = points.position.device.type
        if not compiles(device) or (INTERPRETED and not interpret):
            return f"they cannot be compiled for {device}"
        if points.position.dtype != torch.float32 and device == "cuda":
            return f"it computes in float32, but the material is {points.position.dtype}".replace("torch.", "")
        if bound.settings.deterministic and device == "cuda" and not cls.fixed_order:
            return f"its sums have no fixed order in the {bound.name} formulation, but `deterministic` is set"
        for law in points.laws:
            if law.device is None:
                return f"the law {type(law).__name__} has no device functions"
        return None

    def why_no_gradient(self, state: MPMState, forces: Sequence[Force]) -> str | None:
        """Return the reason why gradients of a rollout need torch's autograd; None if kernels compute them."""
        return "only the total formulation has backward kernels"

    @property
    def recordable(self) -> bool:
        """True if substeps can be recorded in a CUDA graph."""
        return all(boundary.recordable for boundary in self.bound.boundaries)

    @property
    @abstractmethod
    def launches(self) -> bool:
        """True if a substep without forces in torch consists of launches alone."""

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        """Nothing to copy or pickle: a solver builds its buffers and graphs again."""
        return _nothing, ()

    def rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Sequence[Force] = (),
        force: Tensor | None = None,
        drag: Tensor | None = None,
        looks: Sequence[int] = (),
        watch: Callable[[int], None] | None = None,
    ) -> tuple[MPMState, Tensor]:
        """Advance by ``steps`` substeps of ``dt`` [s], with forces or with one constant force (see ``MPMSolver.step``).

        Args:
            force: Force [N], shape (..., P, 3), or None; only without ``forces``.
            drag: Its resistance [kg/s], shape (..., P), or None.
            looks: Numbers of the substeps after which the wave speed is measured, if ``watches``.
            watch: Called with the number of substeps passed to the GPU so far, after each part of the rollout.

        Returns:
            The state, and the most cells that a wave crosses per second at any of the ``looks`` [1/s] (zero without).
        """
        with at_home(self.speed):
            self.speed.zero_()
            here, device_functions, self.asked = divide(forces)
            options = self.options_for(device_functions)
            options["FORCE"] = len(self.asked) > 0 or force is not None or drag is not None
            options["IMPLICIT"] = options["IMPLICIT"] or drag is not None or self._resists(state)
            if options["FORCE"]:
                if len(self.force_in) < self.count:  # needed for the first time
                    self.force_in = torch.zeros(self.count, 4, **self.like)
                self.force_in.zero_()
                self._fill(force, drag)
            loaded = len(device_functions) > 0 or options["FORCE"]
            for first in range(0, steps, MAX_STEPS):
                count = min(steps - first, MAX_STEPS)
                marks = [look - first for look in looks if first < look <= first + count]
                self.schedule[: count + 2].copy_(self.table(kick_time(state, dt), dt, count), non_blocking=True)
                self.time.copy_(state.time)
                self.dt.fill_(dt)
                changes = self._run(state, Part(count, options, marks, loaded, self._key_of(here)))
                changes["impulse"] = state.impulse + changes["impulse"]
                work = changes.pop("work", 0.0) if forces or force is not None else 0.0  # not that of a drag alone
                changes |= {"work": state.work + work, "time": state.time + count * dt, "substep": dt}
                state = self.bound.in_shape(state.replace(**changes))
                if watch is not None:
                    watch(first + count)
            return state, self.speed[0] / self.settings.dx

    def begin(self, steps: int, loaded: bool) -> None:
        """Upload what substeps read besides the state and the schedule."""
        self.first_step.zero_()
        self.loads.begin(self.time, self.dt, steps)
        if loaded:
            self.load.zero_()

    def options_for(self, device_functions: Sequence[DeviceFunction]) -> dict[str, Any]:
        """Compile options of the kernels for some forces; uploads changed parameters."""
        values = self.loads.take(device_functions, MAX_STEPS)
        check_indices(self.loads.layout.size)
        if values is not None:
            self._take_values(values)
        return {
            "LAWS": self.laws,
            "MULTI": len(self.law_table) > 1,
            "VISCOUS": self.settings.stiffness_damping > 0,
            "FORCES": self.loads.layout,
            "FORCE": False,
            "IMPLICIT": any(device_function.implicit for device_function in device_functions),
        }

    def table(self, kick: float, dt: float, steps: int) -> Tensor:
        """The schedule in pinned memory, for a copy without waiting."""
        first, other = (math.exp(-self.settings.damping * time) for time in (kick, dt))
        real = self.like["dtype"]
        table = torch.empty(steps + 2, kernels.SCHEDULE, dtype=real, pin_memory=self.device.type == "cuda")
        table[2:] = torch.tensor([dt, dt, other, 0.0], dtype=real)
        table[:2] = torch.tensor([[0.0, dt, 1.0, kick if steps == 1 else dt], [kick, dt, first, 0.0]], dtype=real)
        return table

    def _key_of(self, forces: Sequence[Force]) -> tuple[object, ...] | None:
        """Return the key of the recorded numbers of forces with device functions; None if they cannot be recorded."""
        near = all(tensor.device == self.device for tensor in tensors_of(forces))
        recordable = near and all(force.recordable for force in forces)
        return (self.loads.layout, *recorded_key(forces)) if recordable else None

    def places(self) -> tuple[int, int]:
        """Return the addresses of the numbers of forces, which recorded graphs contain."""
        return self.loads.buffer.data_ptr(), self.loads.rows.data_ptr()

    # ---- measures, each in one kernel

    def largest_speed(self, state: MPMState) -> Tensor:
        """Cells per second as ``Formulation.cells_per_second``, if it ``watches``."""
        points, laws = self.bound.points, self.bound.laws
        given = state.F_elastic, points.mass / points.volume, laws.mu, laws.lam, state.velocity
        out, block = points.position.new_zeros(1), lanes(self.device, 128)
        with torch.cuda.device_of(out):
            launch(kernels.largest_speed, (-(-self.count // block),))(
                *(value.contiguous() for value in given), out, self.count, WAVE=self.wave,
                SPATIAL=not self.bound.neighbours_fixed, BLOCK=block, num_warps=4,
            )  # fmt: skip
        return self.bound.with_bending(out[0] / self.settings.dx)

    def energy(self, F: Tensor) -> Tensor | None:
        """Energy density [J/m³], shape (..., P); None for laws without a common energy."""
        energy = in_common(self.bound.points.laws, "energy")
        if energy is None:
            return None
        out, block, laws = F.new_empty(F.shape[:-2]), lanes(self.device, 128), self.bound.laws
        with torch.cuda.device_of(out):
            launch(kernels.elastic_energy, (-(-self.count // block),))(
                F.contiguous(), laws.mu.contiguous(), laws.lam.contiguous(), out, self.count, ENERGY=energy,
                BLOCK=block, num_warps=4,
            )  # fmt: skip
        return out

    # ---- forces in torch

    def _fill(self, force: Tensor | None, drag: Tensor | None) -> None:
        points = self.bound.points
        if force is not None:
            self.force_in[:, :3].copy_(force.expand_as(points.position).reshape(-1, 3))
        if drag is not None:
            self.force_in[:, 3].copy_(drag.expand_as(points.mass).reshape(-1))

    def _ask(self, state: MPMState) -> tuple[Tensor | None, Tensor | None]:
        return added([split(force(state), force, state) for force in self.asked])

    def _asked_key(self) -> tuple[object, ...]:
        return recorded_key(self.asked) if self.asked else ()

    def _resists(self, state: MPMState) -> bool:
        key = self._asked_key()
        if key != self._resist[0]:
            self._resist = key, self._ask(state)[1] is not None
        return self._resist[1]

    def _push(self) -> None:
        self._fill(*self._ask(self._look_at()))

    def _room(self, name: str, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        """A buffer for a particle field. Its address stays the same, because graphs write to it and read from it."""
        if name not in self._seen:
            self._seen[name] = torch.zeros(shape, dtype=dtype or self.like["dtype"], device=self.device)
        return self._seen[name]

    @abstractmethod
    def _look_at(self) -> MPMState:
        """Return the state of the particles in the buffers."""

    @abstractmethod
    def _take_values(self, values: Tensor) -> None:
        """Copy the numbers of each particle for the forces, shape (N, n), to the buffers."""

    @abstractmethod
    def _run(self, state: MPMState, part: Part) -> dict[str, Any]:
        """Copy the state to the buffers, run the substeps, and return the fields of the new state.

        ``impulse`` is the reaction impulse on the boundaries in this part, and ``work``, if it is loaded, the work of
        the load in it.
        """

    def _work(self) -> Tensor:
        """Work of the load in each scene [J], shape (...), float64; particles are sorted by scene."""
        work = self.load[0].reshape(self.scenes, self.particles).sum(1, dtype=torch.float64)
        return work.reshape(self.bound.points.mass.shape[:-1])

    def pass_time(self) -> None:
        time, dt = self.time, self.dt
        call(lambda: time.add_(dt), self.device)

    def repeat(self, steps: int, key: Any, body: Callable[[int], None]) -> None:
        """Run ``body(offset)``, one substep, for each offset, from recordings if there are any."""
        whole = (key, self.places(), self._asked_key())
        self.repeater.run(steps, whole, body, self.recordable, self.launches and not self.asked, self.first_step)


@contextmanager
def at_home(buffer: Tensor) -> Iterator[None]:
    """Within the block, launch Triton on a buffer's device, and create tensors outside inference mode."""
    with torch.cuda.device_of(buffer), torch.inference_mode(False), torch.no_grad():
        yield


def check_indices(entries: int) -> None:
    """Raise ValueError if a buffer has more entries than the kernels can address."""
    if entries > MAX_INDEX:
        raise ValueError(
            f"The Triton kernels can use {MAX_INDEX:,} entries of a buffer, but this body or grid needs {entries:,}: "
            "set `solver.transfer` to torch."
        )


def _nothing() -> None:
    """Return None: the placeholder for a Run in a copy."""
