"""Convert a PhysGaussian configuration: ``python tools/convert_physgaussian.py config.json --output my.yaml``."""

from gaussian_swaying.cli.main import run

if __name__ == "__main__":
    run("convert")
