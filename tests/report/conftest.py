"""Results that many tests here read."""

import pytest


@pytest.fixture(scope="session")
def results(tmp_path_factory):
    """As `make_results` makes them: not to be changed."""
    from tests.report.results import make_results

    return make_results(tmp_path_factory.mktemp("made") / "table1")
