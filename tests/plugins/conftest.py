"""Fixtures of the core's tests that tests of plug-ins take too."""

from tests.models.conftest import dataset, model  # noqa: F401
from tests.report.conftest import results  # noqa: F401
from tests.sweeps.conftest import flown, folder  # noqa: F401
