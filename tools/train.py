"""Train Gaussians from photos: ``python tools/train.py fit --config configs/train/quick_cpu.yaml``."""

from gaussian_swaying.cli.main import run

if __name__ == "__main__":
    run("train")
