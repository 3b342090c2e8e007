"""Convert a PhysGaussian configuration: ``gaussian-swaying convert config.json --output my.yaml``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying._files import write_text
from gaussian_swaying._inputs import read_json
from gaussian_swaying.cli.errors import run_command
from gaussian_swaying.interop.physgaussian import convert, to_yaml


def main(arguments: Sequence[str]) -> int:
    """Write the YAML to a file or to standard output; 2 on bad input."""
    parser = argparse.ArgumentParser(
        prog=program.name("convert"),
        description="Convert PhysGaussian's JSON to a YAML for --config; docs/physgaussian.md lists the differences.",
    )
    parser.add_argument("config", type=Path, help="A configuration of PhysGaussian.")
    parser.add_argument("--output", type=Path, help="YAML file to write; by default it is printed.")
    return run_command(
        lambda: write(parser.parse_args(arguments)), stopped="Stopped; nothing was written.", memory="a smaller file"
    )


def write(options: argparse.Namespace) -> None:
    """Convert, write or print the YAML, and report its file and what is left out."""
    settings, notes = convert(read_json(options.config, "PhysGaussian configuration"))
    text = to_yaml(settings, notes, options.config.name)
    if options.output is None:
        print(text, end="")
    else:
        write_text(options.output, text)
        print(f"wrote {options.output}")
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
