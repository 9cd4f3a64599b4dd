"""Groups of rows, as a report has them."""

import pytest

from dgae_jax.report import results
from dgae_jax.report.groups import groups_of
from tests.report.rows import study


@pytest.fixture
def grouped(tmp_path):
    """The groups of rows that went through a file."""
    return lambda rows: groups_of(results.read(study(tmp_path / "grouped", rows)).rows)
