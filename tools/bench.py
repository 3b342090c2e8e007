"""Measure, record, and fill the pages of the documentation from the records.

    python tools/bench.py                          # names of the studies
    python tools/bench.py NAME [--device cuda] [--only TEXT]
    python tools/bench.py NAME --plot              # the figure of a study that has one, from its records
    python tools/bench.py report [--check]

A run appends a line to ``docs/results/NAME.jsonl``. ``report`` fills the tables of docs/*.md.
``tools/bench/speed/turns.py`` compares the speed of two checkouts.
"""

import argparse
import os
import sys

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as in tools/sim.py; must be set before torch is imported

from bench import studies  # the folder next to this file
from bench.report import report
from bench.runner import STUDIES, run


def main(arguments: list[str] | None = None) -> int:
    """Parse and run one command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", help="a study, or `report`")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--only", default="", help="only runs whose parameters contain this text")
    parser.add_argument("--plot", action="store_true", help="draw the figure of a study from its records")
    parser.add_argument("--check", action="store_true", help="of `report`: change nothing, and fail if a page differs")
    options = parser.parse_args(arguments)
    studies.load()
    if options.name == "report":
        stale = report(options.check)
        print(*stale, sep="\n")
        return int(options.check and bool(stale))
    if options.name in STUDIES and options.plot:
        sys.modules[STUDIES[options.name].function.__module__].plot()
    elif options.name in STUDIES:
        run(options.name, options.device, options.only)
    else:
        print(*STUDIES, sep="\n")
    return int(options.name not in (None, *STUDIES))


if __name__ == "__main__":
    sys.exit(main())
