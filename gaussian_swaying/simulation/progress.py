"""Progress of a run: a bar of frames, and progress within a slow frame."""

from __future__ import annotations

import math
import sys
import time

from tqdm import tqdm

LONG_FRAME = 60.0  # s; a first frame that takes longer is reported
MANY_TIMES = 20  # a frame with this many times the substeps of the first is reported
PAUSE = 1.0  # s between two updates within a frame


class RunProgress:
    """A progress bar of frames that also shows the progress within a slow frame, and reports why it is slow.

    Args:
        frames: Frames of the whole run.
        done: Frames that are already done.
        shown: Whether to show anything.
    """

    def __init__(self, frames: int, done: int = 0, shown: bool = True) -> None:
        self.shown = shown
        self._bar = tqdm(total=frames, initial=min(done, frames), unit="frame", disable=not shown, file=sys.stderr)
        self._frames, self._frame = frames, done
        self._usual: int | None = None  # substeps of the first frame that was simulated
        self._told = 0  # substeps of the frame that was last reported
        self._steps = self._first = self._last = 0
        self._began = self._looked = time.perf_counter()

    def begin(self, frame: int) -> None:
        self._frame, self._steps = frame, 0

    def substep(self, done: int, steps: int) -> None:
        now = time.perf_counter()
        if steps != self._steps or done <= self._last:  # a new frame, or the same again with shorter substeps
            self._began = self._looked = now
            self._steps, self._first = steps, done
        self._last = done
        if now - self._looked < PAUSE:
            return
        self._looked = now
        each = (now - self._began) / (done - self._first)
        self._bar.set_postfix_str(
            f"substep {done:,} of {steps:,}, {duration(each * (steps - done))} left in this frame"
        )
        self._tell(steps, each * steps)

    def _tell(self, steps: int, whole: float) -> None:
        many = self._usual is not None and steps > MANY_TIMES * self._usual
        if not self.shown or steps < 4 * self._told or not (many or (self._usual is None and whole > LONG_FRAME)):
            return
        self._told = steps
        text = f"Frame {self._frame} takes {steps:,} substeps, about {duration(whole)}"
        if many and self._usual is not None:
            text += (
                f", {steps // self._usual:,} times those of the first: something stiffened or moves fast. Weaken the "
            )
            text += "wind or other driving forces, or raise `solver.damping`."
        else:
            rest = duration(whole * max(self._frames - self._frame, 1))
            text += f", and the remaining frames about {rest}. For fewer substeps: a lower `material.E`, a higher "
            text += "`material.density`, a coarser `solver.dx`, a longer `solver.substep`."
        tqdm.write(f"note: {text}", file=sys.stderr)

    def end(self, substeps: int, moved: float) -> None:
        """Note that a frame is done.

        Args:
            substeps: Substeps that it took.
            moved: Mean distance of the particles from where they were at rest [m].
        """
        if self._usual is None and substeps > 0:
            self._usual = substeps
        self._bar.update()
        self._bar.set_postfix_str(f"{substeps:,} substeps, {moved:.3f} m from rest on average")

    def close(self) -> None:
        self._bar.close()


def duration(seconds: float) -> str:
    """A duration in a readable form: 12 ms, 3.4 s, 5 min, 2.1 h, 3 days.

    Example:
        >>> [duration(seconds) for seconds in (0.012, 3.4, 300, 7560, 3 * 86400)]
        ['12 ms', '3.4 s', '5 min', '2.1 h', '3 days']
    """
    if not math.isfinite(seconds):
        return "unknown"
    for unit, size, limit in (("ms", 1e-3, 1.0), ("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172800.0)):
        if seconds < limit:
            return f"{seconds / size:.2g} {unit}" if seconds / size < 10 else f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:,.0f} days"
