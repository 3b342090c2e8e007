"""A sweep as WebDataset shards: tar files whose entries are named RUN.WHAT, in the order of the runs."""

from __future__ import annotations

import io
import json
import os
import tarfile
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying._checks import check_positive
from gaussian_swaying._files import atomic
from gaussian_swaying.sweeps.dataset import SweepDataset
from gaussian_swaying.sweeps.record import RUNS

SHARDS = "shards"


def write_shards(
    folder: str | os.PathLike[str],
    runs_per_shard: int = 100,
    output: str | os.PathLike[str] | None = None,
    frames: bool = True,
    positions: bool = False,
    nodes: bool = False,
) -> list[Path]:
    """Write the complete runs of a sweep as tar files ``000000.tar`` and so on, which WebDataset reads.

    A sample has ``json`` (run, settings, summary), ``parameters.npy``, and what is wanted of ``00000.png`` and so on
    (its pictures), ``positions.npy`` and ``nodes.npy``, as in :class:`~gaussian_swaying.sweeps.dataset.SweepDataset`.
    The same runs give the same bytes.

    Args:
        folder: Folder of the sweep.
        runs_per_shard: Runs in a file.
        output: Folder of the files; ``shards`` in the folder of the sweep if None.
        frames: Whether to put in the pictures.
        positions: Whether to put in the trajectories.
        nodes: Whether to put in the displacements of nodes.

    Returns:
        The files.
    """
    check_positive("runs_per_shard", runs_per_shard)
    data = SweepDataset(folder, frames=False, positions=positions, nodes=nodes)
    target = Path(folder) / SHARDS if output is None else Path(output)
    target.mkdir(parents=True, exist_ok=True)
    made = []
    for first in range(0, len(data), runs_per_shard):
        made.append(target / f"{first // runs_per_shard:06d}.tar")
        with atomic(made[-1]) as temporary, tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:
            for index in range(first, min(first + runs_per_shard, len(data))):
                _add_run(tar, data, index, frames)
    for file in target.glob("[0-9]" * 6 + ".tar"):  # of a sweep with fewer complete runs or smaller shards
        if file not in made:
            file.unlink()
    return made


def _add_run(tar: tarfile.TarFile, data: SweepDataset, index: int, frames: bool) -> None:
    item, run = data[index], data.runs[index]
    summary = dict(zip(data.summary_names, item["summary"].tolist(), strict=True))
    told = {"run": run, "settings": data.settings[index], "parameter_names": data.parameter_names}
    told["summary"] = {name: None if value != value else value for name, value in summary.items()}  # NaN is not JSON
    _add(tar, f"{run}.json", json.dumps(told).encode())
    for name in ("parameters", "positions", "nodes"):
        if name in item:
            _add(tar, f"{run}.{name}.npy", _npy(item[name].numpy()))
    pictures = sorted((data.folder / RUNS / run / "frames").glob("[0-9]*.png")) if frames else []
    if frames and not pictures:
        raise ValueError(f"Run {run} has no pictures: leave out `frames`, or sweep with recorder.images: true.")
    for picture in pictures:
        _add(tar, f"{run}.{picture.name}", picture.read_bytes())


def _npy(values: np.ndarray[Any, Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    tar.addfile(entry, io.BytesIO(content))
