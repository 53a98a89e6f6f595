import dataclasses

import numpy as np
import pytest

from jaxreg.search.config import SearchConfig


def test_few_fields():
    assert len(dataclasses.fields(SearchConfig)) <= 8


@pytest.mark.parametrize(
    ("field", "value"),
    [("unit", 0.0), ("unit", np.inf), ("radii", (0.2, -0.4)), ("candidates", 0), ("aligned", -1)],
)
def test_values_out_of_range_are_named(field, value):
    with pytest.raises(ValueError, match=f"{field} = .*positive"):
        SearchConfig(**{field: value})


def test_a_radius_is_needed():
    with pytest.raises(ValueError, match="radii is empty"):
        SearchConfig(radii=())
