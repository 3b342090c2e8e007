"""A solver as a simulation sees it: a body at rest in, states out, and what a frame needs of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.embedded import EmbeddedPoints
from gaussian_swaying.mpm.forces import Forces
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.mpm.timestep import fixed_substeps, look_marks, substeps_per_frame

if TYPE_CHECKING:
    from typing_extensions import Self

WatchFunction = Callable[[int], None]


class Solver(nn.Module, ABC):
    """Base class of solvers: what a :class:`~gaussian_swaying.simulation.simulation.Simulation` needs of one.

    A solver takes material points at rest and advances a :class:`~gaussian_swaying.mpm.state.State` under forces. The
    Gaussians follow the points. Only four methods have to be written; examples/python/own_solver.py is a whole one.

    Attributes:
        formulation: Its name in the summary of a run.
        neighbours_fixed: Whether points keep their neighbours from the rest state: such a body cannot tear or flow.
        dx: Length that the solver resolves [m]: the Gaussians are grouped to points of half of it.
        boundaries: Boundary conditions, in scene units, in order.
        settings: Numbers that may change between two frames, as a frozen dataclass; see :meth:`like`.
        cfl: Courant number of the adaptive substep.
        substep: Fixed substep [s]; None for the adaptive one.
    """

    formulation: str
    neighbours_fixed = True
    settings: Any
    boundaries: nn.ModuleList
    cfl: float = 0.4
    substep: float | None = None

    # ---- what a solver has to have

    @property
    @abstractmethod
    def dx(self) -> float:
        """Length that the solver resolves [m]."""

    @property
    @abstractmethod
    def points(self) -> MaterialPoints:
        """The material given to :meth:`init_state`."""

    @abstractmethod
    def init_state(
        self, points: MaterialPoints, *, frame: SimFrame | None = None, surface: Surface | None = None
    ) -> Any:
        """Take the material at rest and return the state at time zero.

        Args:
            points: The material, shapes (..., P, ·); leading dimensions are the scenes of a batch.
            frame: Transform from scene units to metres, for the boundaries; None if they are in metres.
            surface: Contact samples of the surface; None if nothing touches.
        """

    @abstractmethod
    def rollout(self, state: Any, dt: float, steps: int, forces: Forces | None = None) -> Any:
        """Advance by several substeps.

        Args:
            dt: Substep [s].
        """

    @abstractmethod
    def cells_per_second(self, state: Any) -> Tensor:
        """Lengths ``dx`` that the fastest wave crosses per second, a scalar tensor: it decides the next substep."""

    @abstractmethod
    def elastic_energy(self, state: Any) -> Tensor:
        """Elastic energy [J], shape (...) over the batch."""

    # ---- what it may have

    @property
    def gravity(self) -> tuple[float, ...]:
        """Acceleration [m/s²], z up."""
        return tuple(self.settings.gravity)

    @property
    def stiffness_damping(self) -> float:
        """Time constant of the stiffness damping [s]."""
        return 0.0

    @property
    def exact(self) -> bool:
        """True if no substep is unstable, however fast the waves and however strong the drag."""
        return False

    @property
    def has_kernels(self) -> bool:
        """True if compiled kernels are used where no gradient is needed."""
        return False

    def prepare(self) -> None:
        """Compile what is needed; its errors are raised here."""

    def restiffen(self, youngs_modulus: Tensor, poisson_ratio: Tensor) -> bool:
        """Change the stiffness of the material during a motion.

        Args:
            youngs_modulus: Young's modulus [Pa], shape (..., P).
            poisson_ratio: Poisson's ratio, shape (..., P).

        Returns:
            False if the solver cannot; then call :meth:`init_state` with the new material.
        """
        return False

    def like(self, settings: Any) -> Self:
        """A solver with the same boundaries and other :attr:`settings`, without a material."""
        raise ValueError(f"{type(self).__name__} has no other settings: give it a method `like`.")

    def embedded(self, place: Tensor, arm: Tensor | None, nodes: Tensor | None = None) -> EmbeddedPoints | None:
        """An object that interpolates places in the material from a state; None to follow the nearest points.

        Args:
            place: Rest positions that are read [m], shape (M, 3).
            arm: From there to the places that follow [m], shape (M, 3).
            nodes: Their nodes, shape (27, M), where those of the lattice will not do (``scene.connected: surface``).
        """
        return None

    def continued(self, other: Solver, state: Any, start: Any) -> Any:
        """Continue the motion of another solver from its ``state``; None if this solver cannot."""
        return None

    def describe(self, state: Any) -> dict[str, Any]:
        return {"formulation": self.formulation}

    # ---- time

    def stable_substep(self, state: Any = None) -> float:
        """Longest substep [s] that is stable."""
        raise ValueError(f"{type(self).__name__} has no fixed `substep`: give it a method `stable_substep`.")

    def substeps(self, state: Any, frame_dt: float, cells: float | None = None) -> int:
        """Return the number of equal substeps of the next frame of ``frame_dt`` seconds.

        Args:
            frame_dt: Length of the frame [s].
        """
        if self.substep is not None:
            return fixed_substeps(frame_dt, self.substep, self.stable_substep(state), self.dx)
        fastest = float(self.cells_per_second(state)) if cells is None else cells
        return substeps_per_frame(frame_dt, self.cfl / max(fastest, 1e-30), exact=False)

    def cfl_number(self, state: Any, dt: float) -> Tensor:
        """Largest Courant number of a substep of ``dt`` [s], a scalar tensor."""
        return dt * self.cells_per_second(state)

    def fit_grid(self, state: Any, horizon: float, margin: int = 0) -> Any:
        """The state with room for the next ``horizon`` seconds, and for ``margin`` more cells on each side."""
        return state

    def watched_rollout(
        self,
        state: Any,
        dt: float,
        steps: int,
        forces: Forces | None = None,
        looks: int = 8,
        watch: WatchFunction | None = None,
        check: bool = False,
    ) -> tuple[Any, Tensor]:
        """Advance by several substeps and check the Courant number on the way, as material may stiffen or soften.

        Args:
            dt: Substep [s].
            watch: Called from time to time with the number of substeps that are done, or queued on a GPU.
            check: Whether to raise errors at once; if not, the measurements of the frame find what is wrong.

        Returns:
            The state ``steps * dt`` later, and the largest Courant number seen, a scalar tensor.
        """
        seen = []
        for first, last in pairwise([0, *look_marks(steps, looks)]):
            state = self.rollout(state, dt, last - first, forces)
            seen.append(self.cfl_number(state, dt))
            if watch is not None:
                watch(last)
        return state, torch.stack(seen).amax()

    # ---- measurements

    def energies(self, state: Any) -> dict[str, Tensor]:
        """Kinetic, elastic and gravitational energy [J], each of shape (...) over the batch."""
        mass = self.points.mass
        height = (state.position * state.position.new_tensor(self.gravity)).sum(-1)
        return {
            "kinetic": 0.5 * (mass * state.velocity.square().sum(-1)).sum(-1),
            "elastic": self.elastic_energy(state),
            "potential": -(mass * height).sum(-1),
        }

    def momenta(self, state: Any) -> dict[str, Tensor]:
        """Linear [kg m/s] and angular momentum about the origin [kg m²/s], each of shape (..., 3)."""
        momentum = self.points.mass[..., None] * state.velocity
        return {"linear": momentum.sum(-2), "angular": torch.linalg.cross(state.position, momentum).sum(-2)}

    def framed(self, frame: SimFrame | None) -> Sequence[Boundary]:
        """The boundaries in metres."""
        given = [part for part in self.boundaries if isinstance(part, Boundary)]
        return given if frame is None else [part.in_frame(frame) for part in given]
