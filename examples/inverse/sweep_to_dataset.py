"""Many runs as a data set. A sweep runs a flag in four winds; WebDataset reads batches for a network from its shards.

The command for the first half is `gaussian-swaying sweep SWEEP.yaml --together 4 --shards 100`.
"""

from pathlib import Path

import webdataset

from gaussian_swaying.cli.shipped import folder as folder_of_shipped
from gaussian_swaying.sweeps.dataset import write_shards
from gaussian_swaying.sweeps.plan import read_sweep
from gaussian_swaying.sweeps.run import run_sweep

SWEEP = """
base: {base}
settings: {{frames: 6, scene.generator.init_args.spacing: 0.05, solver.dx: 0.2}}
axes:
  wind.flow: [[2, -1, 0], [2, 1, 0], [4, -1, 0], [4, 1, 0]]
"""

if __name__ == "__main__":  # the workers import this file
    Path("flags.yaml").write_text(SWEEP.format(base=folder_of_shipped() / "sim" / "flag.yaml"))
    plan = read_sweep("flags.yaml")
    run_sweep(plan, "flags", workers=1, together=4, device="cpu", progress=False)
    shards = [str(file) for file in write_shards("flags", positions=True)]
    data = webdataset.WebDataset(shards, shardshuffle=False).decode().to_tuple("parameters.npy", "positions.npy")
    for parameters, positions in data.batched(4):  # (4, A), and (4, T, P, 3)
        aside = (positions - positions[:, :1]).mean((1, 2))[:, 1]
        print(*(f"wind {wind.tolist()} m/s: {y:+.3f} m" for wind, y in zip(parameters, aside, strict=True)), sep="\n")
    assert (aside * parameters[:, 1] > 0).all(), "a flag goes where its wind goes"
