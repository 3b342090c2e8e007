"""Solve a flag with Blender's cloth in a process of its own, and time it: for ``bench.py blender``.

``python tools/datasets/time_cloth.py FIELDS FILE.npz``: the fields of a :class:`FlagPattern` as JSON, and where to
write ``positions`` [m] of each frame, shape (frames, V, 3), and ``seconds``, the time from the first frame to the last.
Of packages it needs only ``bpy`` and NumPy, so Blender may have an environment of its own.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
from blender_cloth import solve_cloth
from flag_reference import FlagPattern


def solve(fields: dict[str, Any]) -> tuple[np.ndarray, float]:
    """The vertices of a flag at each frame [m], and the seconds from the first frame, which is at rest, to the last."""
    flag, times = FlagPattern(**fields), list[float]()
    grid = flag.grid()
    places = grid.uv()
    rest, _ = flag.rest(places)
    positions = solve_cloth(
        grid, rest, flag.pins(places), flag.material(), flag.run(), lambda _: times.append(time.perf_counter())
    )
    return positions, times[-1] - times[0]


if __name__ == "__main__":
    found, seconds = solve(json.loads(sys.argv[1]))
    np.savez(sys.argv[2], positions=found, seconds=seconds)
