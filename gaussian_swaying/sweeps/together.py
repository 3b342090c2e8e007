"""Runs of equal shape that are simulated together: which they are, and how a worker does them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gaussian_swaying.config.parser import config_text
from gaussian_swaying.simulation.model import POLAR, find, in_settings, names
from gaussian_swaying.simulation.simulation import Simulation, run_batch
from gaussian_swaying.sweeps.backend import Job, unlocked
from gaussian_swaying.sweeps.plan import parse_run
from gaussian_swaying.sweeps.record import RUNS

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace


OPTIONS = [name for name in names() if name not in POLAR and "*" not in name]
"""Parameters that are options of ``sim``."""


def shares_rollout(name: str) -> bool:
    """True if runs that differ only in this axis can share a rollout, as they have the same material points."""
    known = find(name)
    return known is not None and known.batched and known.same_points and name in OPTIONS


def grouped(runs: Sequence[Mapping[str, Any]], size: int) -> list[list[int]]:
    """Numbers of the runs that are simulated together, at most ``size`` of them.

    It depends on nothing but the runs and the size, so that a sweep that is resumed has the same groups.

    Args:
        runs: The value of every axis in each run.
        size: Largest number of runs in a group.

    Example:
        >>> grouped([{"wind.seed": 1, "solver.dx": x} for x in (1, 2, 1, 1)], 2)
        [[0, 2], [3], [1]]
    """
    alike: dict[str, list[int]] = {}
    for number, run in enumerate(runs):
        key = json.dumps({name: value for name, value in run.items() if not shares_rollout(name)})
        alike.setdefault(key, []).append(number)
    return [numbers[k : k + size] for numbers in alike.values() for k in range(0, len(numbers), size)]


def run_together(job: Job, parser: ArgumentParser) -> dict[str, dict[str, Any]]:
    """Do the runs of a job in one rollout.

    Args:
        job: The job.
        parser: From :meth:`Simulation.parser`.

    Returns:
        The summaries of its runs by name, without those that are complete.
    """
    members, frames = members_of(job, parser)
    folders = [None if name in job.complete else job.folder / RUNS / name for name in job.names]
    extras = [{"sweep": {"run": n, "settings": r}} for n, r in zip(job.names, job.runs, strict=True)]
    summaries = unlocked(lambda: run_batch(members, folders, frames, extras))
    return {name: summary for name, summary in zip(job.names, summaries, strict=True) if summary is not None}


def members_of(job: Job, parser: ArgumentParser) -> tuple[list[Simulation], int]:
    """The simulations of all runs of a job, and how many frames they have."""
    settings = [parse_run(parser, job.config, job.frames, job.runs[0])]
    settings[0].device = job.device
    changes: list[dict[str, Any]] = [{}]
    for run in job.runs[1:]:  # parsing takes longer than a frame of all
        settings.append(settings[0].clone())
        changes.append({name: value for name, value in run.items() if shares_rollout(name)})
        in_settings(settings[-1], changes[-1])
    first = Simulation.from_settings(parser, settings[0])
    first.start()  # with all checks of a run
    written = texts(parser, settings, [name for name in job.runs[0] if shares_rollout(name)])
    members = [first]
    for one, own, text in zip(settings[1:], changes[1:], written[1:], strict=True):
        members.append(first.variant(own, parser.instantiate(one).recorder, text))
    return members, settings[0].frames


def texts(parser: ArgumentParser, settings: Sequence[Namespace], names: Sequence[str]) -> list[str]:
    """The configuration of each run as YAML, as :func:`~gaussian_swaying.config.parser.config_text` writes it.

    The parser takes longer for one than a GPU takes for a frame of all, so it writes the first one, and the values that
    differ are put in.

    Args:
        parser: From :meth:`Simulation.parser`.
        settings: Of each run.
        names: Options in which they differ.
    """
    import yaml

    def written(content: dict[str, Any]) -> str:
        return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))

    first = config_text(parser, settings[0])
    content = yaml.safe_load(first)
    if written(content) != first:  # another version of the parser writes it in another way
        return [config_text(parser, one) for one in settings]
    configs = []
    for one in settings:
        for group, field in (name.split(".") for name in names):
            content[group][field] = one[group][field]
        configs.append(written(content))
    return configs
