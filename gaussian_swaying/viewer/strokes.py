"""Labels of a splat that change stroke by stroke, and go back."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.gaussians.parts import ROLES, Part, Parts

MOST_KEPT = 100  # strokes that can be taken back


@dataclass(frozen=True, eq=False)
class Stroke:
    """A stroke, and what it replaced.

    Attributes:
        part: The part to which it gave Gaussians.
        mark: As in :meth:`Strokes.paint`.
        index: The Gaussians that it changed, each once, shape (M,).
        labels: Their labels before, shape (M,).
        known: The parts before.
    """

    part: Part
    mark: Hashable
    index: Tensor
    labels: Tensor
    known: tuple[Part, ...]


class Strokes:
    """The labels of all Gaussians of a splat, stroke by stroke.

    Args:
        parts: The parts at first.

    Attributes:
        known: The parts that there are.
        labels: The part of each Gaussian, as its place in ``known``, int64, shape (N,).
        roles: Index of each Gaussian's role in :data:`~gaussian_swaying.gaussians.parts.ROLES`, uint8, shape (N,);
            another tensor after each change.
    """

    def __init__(self, parts: Parts) -> None:
        self.labels, self.known = parts.labels.clone(), parts.parts
        self._past: deque[Stroke] = deque(maxlen=MOST_KEPT)
        self.roles = self._roles_of(self.labels)

    def __len__(self) -> int:
        """The number of strokes that can be taken back."""
        return len(self._past)

    @property
    def last(self) -> Stroke | None:
        """The last stroke, or None."""
        return self._past[-1] if self._past else None

    def parts(self) -> Parts:
        return Parts(self.labels.clone(), self.known)

    def paint(self, part: Part, index: Tensor, mark: Hashable = None, goes_on: bool = False) -> None:
        """Give Gaussians to a part, which is new or the one with its name; nothing happens if it has them all.

        Args:
            part: The part.
            index: The Gaussians, each once, int64, shape (M,).
            mark: Anything that tells strokes apart.
            goes_on: Whether this belongs to the last stroke, if part and mark are the same; both go back together.
        """
        names, known = [each.name for each in self.known], self.known
        place = names.index(part.name) if part.name in names else len(names)
        index = index[self.labels[index] != place]
        if len(index) == 0:
            return
        labels = self.labels[index]
        last = self.last
        if goes_on and last is not None and (last.part, last.mark) == (part, mark):
            self._past.pop()
            index, labels, known = torch.cat([last.index, index]), torch.cat([last.labels, labels]), last.known
        self._past.append(Stroke(part, mark, index, labels, known))
        self.known = (*self.known[:place], part, *self.known[place + 1 :])
        self._label(index, torch.full_like(index, place))

    def take_back(self) -> None:
        """Take the last stroke back; nothing happens without one."""
        if self._past:
            last = self._past.pop()
            self.known = last.known
            self._label(last.index, last.labels)

    def _label(self, index: Tensor, labels: Tensor) -> None:
        self.labels[index] = labels
        roles = self.roles.clone()
        roles[index] = self._roles_of(labels)
        self.roles = roles

    def _roles_of(self, labels: Tensor) -> Tensor:
        return torch.tensor([ROLES.index(part.role) for part in self.known], dtype=torch.uint8)[labels]
