"""Many runs as a data set: ``python examples/sweep_to_dataset.py`` runs a flag in nine winds, and reads batches."""

import sys
from pathlib import Path

import webdataset

from gaussian_swaying.cli.shipped import folder as folder_of_shipped
from gaussian_swaying.sweeps.dataset import write_shards
from gaussian_swaying.sweeps.plan import make_plan, read_sweep
from gaussian_swaying.sweeps.run import run_sweep


def main(
    folder: Path, frames: int = 13, speeds: int = 3, workers: int | None = None
) -> list[tuple[list[float], float]]:
    """Do the runs, and return for each the wind [m/s] and how far aside its flag is on average [m].

    Args:
        folder: Of the sweep; the runs, their videos, a table and a contact sheet go there.
        frames: Frames of each run; the first is at rest.
        speeds: Number of speeds, each in three directions.
        workers: Runs at a time; None for one on each core.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    plan_file = folder.parent / f"{folder.name}.yaml"
    flows = [[1.5 * (k + 1), side, 0.0] for k in range(speeds) for side in (-0.5, 0.0, 0.5)]
    plan_file.write_text(
        f"base: {folder_of_shipped() / 'sim' / 'flag.yaml'}\n"
        f"settings: {{frames: {frames}, scene.generator.init_args.spacing: 0.05, solver.dx: 0.1}}\n"
        f"axes:\n  wind.flow: {flows}\n",
        encoding="utf-8",
    )
    run_sweep(make_plan(read_sweep(plan_file)), folder, workers=workers, together=8, device="cpu", progress=False)
    shards = [str(file) for file in write_shards(folder, positions=True)]
    data = webdataset.WebDataset(shards, shardshuffle=False).decode().to_tuple("parameters.npy", "positions.npy")
    found = []
    for parameters, positions in data.batched(3):  # (3, A), and (3, T, P, 3)
        aside = (positions - positions[:, :1]).mean((1, 2))[:, 1]
        found += list(zip(parameters.tolist(), aside.tolist(), strict=True))
    return found


if __name__ == "__main__":  # the workers import this file
    to = Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/sweep_to_dataset")
    rows = main(to)
    for wind, aside in rows:
        print(f"wind {wind} m/s: {aside:+.3f} m")
    assert all(aside * wind[1] > 0 for wind, aside in rows if wind[1] != 0), "a flag goes where its wind goes"
    print(f"the contact sheet is {to}/contact_sheet.png")
