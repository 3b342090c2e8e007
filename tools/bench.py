"""Run measurements, record them as JSON, and fill the tables of the documentation from the records.

``python tools/bench.py NAME`` measures and writes ``docs/results/NAME_<device>.json``; ``pages`` fills the slots of
docs/*.md and README.md from these records; ``pictures`` and ``film`` make pictures of finished runs.
"""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as in tools/sim.py; must be set before torch is imported

from bench.command import main  # the folder next to this file

if __name__ == "__main__":
    main(__doc__ or "")
