"""The core names nothing that only a plug-in brings: no message, help, option or key of it (quadexp/plugin.py)."""

import ast
import re

import pytest

from quadexp.plugin import shipped_plugins
from tests.brought import named_in, options_of
from tests.house import PACKAGE, ROOT, modules, place

# Of a text of the core: (file, what it names) -> why it stands.
ALLOWED = {
    ("plugin.py", "quadexp/plugins/logs"): "says of a seam who asks for what is brought",
    ("plugin.py", "quadexp/plugins/page"): "the same",
    ("plugin.py", "quadexp/plugins/exchange"): "the same",
    ("plugin.py", "quadexp export"): "the same",
    ("models/dataset.py", "from_model"): "plants of stored flights, whose noise is known",
    ("models/dataset.py", "blade_element"): "the same",
    ("control/mpc/part.py", "sum_mpc"): "in hashes of stored flights; the class is the core's",
}


def texts() -> list[tuple[str, int, str]]:
    """File, line and text of every string of the core, docstrings too."""
    found = []
    for name, path in modules().items():
        if place(name).startswith("plugins"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append((str(path.relative_to(PACKAGE)), node.lineno, node.value))
    return found


TEXTS = texts()


def test_the_finder_finds():
    """What a core that names plug-ins would say."""
    said = {"laws": "controller=pid", "page": "see --watch", "logs": "`quadexp import` reads", "remedies": "delay=none"}
    for plugin, text in said.items():
        assert plugin not in shipped_plugins() or named_in(text, plugin), plugin
    assert len(TEXTS) > 2000


@pytest.mark.parametrize("plugin", shipped_plugins())
def test_no_text_of_the_core_names_it(plugin):
    named = [(file, line, word) for file, line, text in TEXTS for word in named_in(text, plugin)]
    assert [(file, line, word) for file, line, word in named if (file, word) not in ALLOWED] == []


@pytest.mark.parametrize("plugin", shipped_plugins())
def test_no_option_that_is_taken_by_default_needs_it(plugin):
    stated = (ROOT / "conf" / "config.yaml").read_text(encoding="utf-8")
    chosen = {f"{group}/{name}" for group, name in re.findall(r"^ *- (\w+): (\w+)", stated, re.MULTILINE)}
    assert len(chosen) > 10 and not chosen & options_of(plugin)
