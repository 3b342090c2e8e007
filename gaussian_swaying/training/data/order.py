"""The order of training images."""

from collections.abc import Iterator
from itertools import islice

import torch
from torch.utils.data import Sampler


class EndlessShuffle(Sampler[int]):
    """Endless indices of ``count`` images: each round is a permutation given by the seed and the number of the round.

    A run that continues after ``start`` images gets exactly the same images as one without a stop.

    Args:
        count: Number of images.
        seed: Seed of the permutations.
        start: Number of images already seen.
        every: Take only every so many of them, from ``start`` on: the share of one of several devices.

    Raises:
        ValueError: If there is no image, or ``start`` is negative.

    Example:
        >>> from itertools import islice
        >>> list(islice(EndlessShuffle(3, seed=0), 2, 7)) == list(islice(EndlessShuffle(3, seed=0, start=2), 5))
        True
    """

    def __init__(self, count: int, seed: int = 0, start: int = 0, every: int = 1) -> None:
        if count < 1:
            raise ValueError("Expected at least one image to train on, but got none.")
        if start < 0:
            raise ValueError(f"Expected `start` not to be negative, but got {start}.")
        self.count, self.seed, self.start, self.every = count, seed, start, every

    def __iter__(self) -> Iterator[int]:
        """Indices from ``start`` on."""
        return islice(self._all(), 0, None, self.every)

    def _all(self) -> Iterator[int]:
        number, skip = divmod(self.start, self.count)
        while True:
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + number)
            yield from torch.randperm(self.count, generator=generator)[skip:].tolist()
            number, skip = number + 1, 0
