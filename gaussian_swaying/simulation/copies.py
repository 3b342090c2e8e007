"""Copies of one object: where they stand, and the wind that each of them feels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_vector, check_whole
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import fixed
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.simulation.parameters import Setup
from gaussian_swaying.simulation.simulated_scene import SimulatedScene
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import Places, Wind
from gaussian_swaying.wind.tables import Shelter

RENDERS = ("color", "depth", "normal")
"""Renders of a run with copies."""


@fixed
@dataclass
class Copy:
    """One of several copies of the object. Without values it is the object itself, at its own place.

    Args:
        shift: Where it stands, from the place of the object [m]: z up, along the axes of the wind.
        turn: Angle about the vertical, counterclockwise from above [degrees]. The axis goes through the middle of what
            the pins hold, such as the foot of a plant; through the middle of the object if nothing is held.
        delay: Time by which the wind and its gusts come later than for the object [s].
        seed: Seed of its gusts. Null for gusts of its own, with the seed of the wind plus the number of the copy (from
            0 on); or with a ``delay`` for those of the wind, only later.
    """

    shift: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    turn: float = 0.0
    _: KW_ONLY
    delay: float = 0.0
    seed: int | None = None

    def __post_init__(self) -> None:
        self.shift = list(check_vector("copies.shift", self.shift))
        for name in ("turn", "delay"):
            check_vector(f"copies.{name}", [getattr(self, name)], 1)
        if self.seed is not None:
            check_whole("copies.seed", self.seed, 0)


class Copies(nn.Module):
    """The copies of a scene: ``x`` of the object lies at ``A x + b`` in each copy.

    Args:
        copies: The copies.
        scene: The scene.
        boundaries: The boundaries of the solver; the turns are about what its pins hold.

    Attributes:
        places: Their places in the wind.
        rotation: ``A``, the rotation along the axes of the scene, shape (B, 3, 3), float64.
        offset: ``b`` [scene units], shape (B, 3), float64.
    """

    def __init__(self, copies: Sequence[Copy], scene: SimulatedScene, boundaries: Iterable[nn.Module] = ()) -> None:
        super().__init__()
        self.copies, frame = tuple(copies), scene.frame
        eye, axes = torch.eye(3, dtype=torch.float64), frame.rotation
        turn = torch.stack([_turn(copy.turn) for copy in copies])
        shift = torch.tensor([copy.shift for copy in copies], dtype=torch.float64)
        shift = shift + (eye - turn) @ _foot(scene, boundaries)
        rotation = eye + axes.T @ (turn - eye) @ axes  # exactly I where the copy is not turned
        offset = (eye - rotation) @ frame.origin + shift @ axes / frame.metres_per_unit
        delay = torch.tensor([copy.delay for copy in copies], dtype=torch.float64)
        self.places = Places(turn, shift, delay)
        for name, value in {"rotation": rotation, "offset": offset}.items():
            self.register_buffer(name, value, persistent=False)
        self.rotation: Tensor
        self.offset: Tensor

    def __len__(self) -> int:
        return len(self.copies)

    def winds(self, wind: Wind) -> Wind | Sequence[Wind]:
        """The wind of the object with the gusts of each copy."""
        if not isinstance(wind, WindField):
            return [wind] * len(self)
        own = int(wind.seed)
        return wind.with_seeds([
            copy.seed if copy.seed is not None else own + number * (copy.delay == 0)
            for number, copy in enumerate(self.copies)
        ])  # fmt: skip

    def place(self, copy: int, points: Tensor) -> Tensor:
        """Points (..., 3) of the object as they lie in a copy [scene units]; computed in float64, for far copies."""
        return (in_double(points) @ self.rotation[copy].mT + self.offset[copy]).to(points)

    def in_object(self, point: Tensor) -> Tensor:
        """The points of the object that lie at a point (3,) of the scene in each copy [scene units], shape (B, 3)."""
        found: Tensor = ((point.to(self.offset) - self.offset)[:, None] @ self.rotation)[:, 0]
        return found


def copies_of(copies: Sequence[Copy], setup: Setup, solver: Solver) -> Copies:
    """The copies of the object of a simulation.

    Args:
        copies: The copies.
        setup: Scene, material and drivers of the object.
        solver: Its solver.
    """
    why = _why_not(copies, setup, solver)
    if why is not None:
        raise ValueError(why)
    return Copies(copies, setup.scene, solver.boundaries)


def _why_not(copies: Sequence[Copy], setup: Setup, solver: Solver) -> str | None:
    wind = setup.wind
    if setup.air is not None:
        return "`copies` cannot have computed air yet, which belongs to one object: set `air` to null."
    if setup.scene.surface_places is not None:
        return "`copies` cannot touch anything yet: set `contact` to null, and remove obstacles from the solver."
    if setup.forces:
        return "`copies` cannot have `forces` yet, as these act on one object: remove them."
    if isinstance(wind, WindField) and any(isinstance(effect, Shelter) for effect in wind.effects):
        return "`copies` cannot have a Shelter yet, which belongs to one object: remove it from `wind.effects`."
    if any(copy.seed is not None for copy in copies) and not isinstance(wind, WindField):
        return "Expected `copies.seed` null with a wind of your own, which has no seed: use `delay`."
    if any(copy.turn for copy in copies) and any(solver.gravity[:2]):
        return "`copies` with a `turn` need `solver.gravity` along z: each is simulated in its own turned axes."
    return None


def check_recorder(recorder: Recorder) -> None:
    """Raise ValueError if a recorder writes what runs with copies do not have."""
    wrong = [name for name in ("trajectory", "nodes") if getattr(recorder, name)]
    if wrong:
        names = " and ".join(f"`recorder.{name}`" for name in wrong)
        raise ValueError(f"`copies` are recorded as pictures only: set {names} to false.")
    wrong = [render for render in recorder.renders if render not in RENDERS]
    if wrong:
        raise ValueError(f"`copies` have no pictures of {' and '.join(wrong)} yet: remove it from `recorder.renders`.")


def _turn(degrees: float) -> Tensor:
    """Rotation about z, shape (3, 3), float64."""
    s, c = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _foot(scene: SimulatedScene, boundaries: Iterable[nn.Module]) -> Tensor:
    """Middle of what the pins hold [m], or of the object, shape (3,), float64."""
    points = scene.points.position.detach().double()
    held = []
    for pin in boundaries:
        if isinstance(pin, PinnedPoints):
            held.append(scene.frame.point_to_sim(pin.at))
        elif isinstance(pin, PinnedRegion):
            held.append(points[pin.region.contains(scene.frame.point_to_scene(points))])
    found = torch.cat(held) if held else points[:0]
    if not len(found):
        return torch.zeros(3, dtype=torch.float64)
    low, high = found.aminmax(dim=0)
    return 0.5 * (low + high)
