"""Convert a PhysGaussian configuration: ``python tools/convert_physgaussian.py config.json --output my.yaml``."""

import sys

from gaussian_swaying.cli.convert import main

if __name__ == "__main__":
    sys.exit(main())
