"""Where the folder of a plug-in is deleted, tests of the core that need a part of it are skipped.

A test, or a module of tests, that fails because the program says that the plug-in is not there is skipped and not
failed. Where all plug-ins are there, nothing is.
"""

import re
from pathlib import Path

import pytest

from quadexp.plugin import shipped_plugins
from tests.house import PLUGIN_FLOORS, ROOT

DELETED = frozenset(name for floor in PLUGIN_FLOORS for name in floor) - set(shipped_plugins())
NAMED = re.compile(rf"(?:quadexp|tests)[./]plugins[./]({'|'.join(sorted(DELETED))})\b")
# What the program says, beside naming the module: of a service, a command, a name of the Python API.
SAYS_SO = ("no installed plug-in", "No such command", "No such option", "module 'quadexp' has no attribute")


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Whether it is the folder of a deleted plug-in's own tests; None lets pytest decide."""
    own = collection_path.parent == ROOT / "tests" / "plugins" and collection_path.name in DELETED
    return True if own else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    return skipped_without_plugin((yield), collector.path)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    return skipped_without_plugin((yield), item.path)


def needs(*names: str) -> pytest.MarkDecorator:
    """A test, or with `pytestmark` a module, is about these plug-ins; without names, about all of them."""
    lacking = sorted(DELETED & set(names) if names else DELETED)
    return pytest.mark.skipif(bool(lacking), reason=f"the plug-in {', '.join(lacking)} is not there")


def skip_if_it_says_so(said: str) -> None:
    """Skip the test where a command refuses for want of a deleted plug-in. said: on its error stream."""
    if DELETED and (NAMED.search(said) or any(text in said for text in SAYS_SO)):
        pytest.skip("the plug-in of a command is not there")


def skipped_without_plugin(report, path: Path):
    """The report, of a failure for want of a deleted plug-in as of a test that is skipped."""
    if DELETED and report.failed:
        text = "\n".join([report.longreprtext, *(content for _, content in report.sections)])
        named = NAMED.search(text)
        if named or any(said in text for said in SAYS_SO):
            report.outcome = "skipped"
            lacking = named.group(1) if named else "a deleted one"
            report.longrepr = (str(path), 0, f"Skipped: the plug-in {lacking} is not there")
    return report
