"""Compare a run with a reference: ``python tools/eval.py RUN REFERENCE --output DIR``."""

from gaussian_swaying.cli.main import run

if __name__ == "__main__":
    run("eval")
