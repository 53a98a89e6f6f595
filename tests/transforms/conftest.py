import jax
import pytest

from tests.transforms.table import TABLE


@pytest.fixture
def row(request):
    """A row of the table, with JAX's promotion as it asks for."""
    row = TABLE[request.param]
    if row.loose:
        jax.config.update("jax_numpy_dtype_promotion", "standard")
    return row
