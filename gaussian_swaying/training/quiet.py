"""Messages of Lightning that are not useful here: advertisements, and warnings about things that are taken care of."""

from __future__ import annotations

import logging
import warnings

_WARNINGS = (
    "Using ModelCheckpoint with manual optimization",  # checkpoints are written after the step, as a resumed run needs
    "(?s).*does not have many workers",
    ".*LeafSpec",
    "Checkpoint directory .* exists and is not empty",  # it is moved aside, or it belongs to the run that is resumed
    # the order of images follows from the step
    "(?s)You're resuming from a checkpoint that ended before the epoch ended",
    "LightningCLI's args parameter is intended",
)


def _is_useful(record: logging.LogRecord) -> bool:
    return "💡" not in record.getMessage()


def silence_advertisements() -> None:
    """Hide Lightning's tips about other products, and nothing else."""
    for name in ("lightning.fabric.utilities.rank_zero", "lightning.pytorch.utilities.rank_zero"):
        logger = logging.getLogger(name)
        if _is_useful not in logger.filters:
            logger.addFilter(_is_useful)


def silence_warnings() -> None:
    """Hide warnings of Lightning and torch about things that are taken care of here."""
    for message in _WARNINGS:
        warnings.filterwarnings("ignore", message=message)
