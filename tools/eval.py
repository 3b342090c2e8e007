"""Compare a run with a reference: ``python tools/eval.py RUN REFERENCE --output DIR``."""

import sys

from gaussian_swaying.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
