"""What Lightning says that is of no use here: advertisements, and warnings about what is taken care of."""

from __future__ import annotations

import logging
import warnings

_WARNINGS = (
    "Using ModelCheckpoint with manual optimization",  # checkpoints are written after the step, as a resumed run needs
    "(?s).*does not have many workers",
    ".*LeafSpec",
    "Checkpoint directory .* exists and is not empty",  # it is moved aside, or of the training that is continued
    # the order of images follows from the step
    "(?s)You're resuming from a checkpoint that ended before the epoch ended",
    "LightningCLI's args parameter is intended",
)


def _is_useful(record: logging.LogRecord) -> bool:
    return "💡" not in record.getMessage()


def silence_advertisements() -> None:
    """Leave out Lightning's tips on other products, and nothing else that it says."""
    for name in ("lightning.fabric.utilities.rank_zero", "lightning.pytorch.utilities.rank_zero"):
        logger = logging.getLogger(name)
        if _is_useful not in logger.filters:
            logger.addFilter(_is_useful)


def silence_warnings() -> None:
    """Leave out warnings of Lightning and torch about what is taken care of here."""
    for message in _WARNINGS:
        warnings.filterwarnings("ignore", message=message)
