"""Groups of rows that were written and read."""

import pytest

from dgae_jax.report import results
from dgae_jax.report.groups import groups_of
from tests.report.rows import study


@pytest.fixture
def grouped(tmp_path):
    return lambda rows: groups_of(results.read(study(tmp_path / "grouped", rows)).rows)
