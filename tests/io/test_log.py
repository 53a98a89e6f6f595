"""The log of a training run."""

import numpy as np
import pytest

from jaxreg.io.log import read_metrics


def test_read_metrics_gives_columns_with_gaps(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "loss": 3}\n{"step": 2, "loss": 2, "val": 0.5}\n')
    columns = read_metrics(path)
    np.testing.assert_array_equal(columns["loss"], [3, 2])
    np.testing.assert_array_equal(columns["val"], [np.nan, 0.5])


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "no metrics at"), ("", "is empty"), ('{"step": 1}\nrubbish', "line 2 is not a JSON")],
)
def test_read_metrics_names_what_is_wrong(tmp_path, content, message):
    path = tmp_path / "metrics.jsonl"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_metrics(path)
