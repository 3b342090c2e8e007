"""Rows of a log are added, never taken away."""

import pytest
from shared import rows

from gaussian_swaying.training.csv_log import CsvLog, append_row


def test_rows_and_columns_are_added(tmp_path):
    """By several loggers in turn, as in a training that is continued, or looked at by another process."""
    path = tmp_path / "csv" / "metrics.csv"
    one, two = CsvLog(path.parent), CsvLog(path.parent)
    assert not path.parent.exists()
    one.log_metrics({"loss": 1.5}, 1)
    two.log_metrics({"psnr": 20.0, "a": 3}, 1)
    one.log_metrics({"loss": 0.5}, 2)
    assert rows(path) == [
        {"loss": "1.5", "step": "1", "a": "", "psnr": ""},
        {"loss": "", "step": "1", "a": "3.0", "psnr": "20.0"},
        {"loss": "0.5", "step": "2", "a": "", "psnr": ""},
    ]
    assert [file.name for file in path.parent.iterdir()] == ["metrics.csv"]


@pytest.mark.parametrize(
    "start", ["", "step,loss\r\n", "step,loss\n1,2.0\n2,", "step,loss\r\n1,2.0\r\n2,3.", "\xff,\xfe\n"]
)
def test_a_log_that_was_cut_off_goes_on(start, tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_bytes(start.encode("latin-1"))
    append_row(path, {"step": 3, "loss": 1.0})
    found = rows(path)
    assert {name: found[-1][name] for name in ("step", "loss")} == {"step": "3", "loss": "1.0"}
    assert len(found) == max(len(start.splitlines()), 1)
