"""Keys and options of earlier versions are refused by name, on the command line and in files, with the new line."""

from __future__ import annotations

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.parts.former import FORMER
from quadexp.parts.schema import CHOSEN
from tests.docs.commands import ROOT


@pytest.mark.parametrize("text", FORMER)
def test_each_is_refused_with_what_replaces_it(text):
    group = text.partition(".")[0]
    asked = [text] if "=" in text else [f"{group}={CHOSEN[group]}", f"{text}=1"]
    with pytest.raises(UsageError) as error:
        compose(asked)
    assert str(error.value) == f"{text}: is no more: {FORMER[text]}"
    assert text.replace("=", ".") in (ROOT / "docs" / "migrating.md").read_text().replace("=", ".")


def test_in_a_file_of_the_users_own_too(tmp_path):
    (tmp_path / "engine").mkdir()
    content = "defaults: [/schema/engine/jobs@_here_, _self_]\nname: ours\nqueue: short\n"
    (tmp_path / "engine" / "ours.yaml").write_text(content)
    with pytest.raises(UsageError, match="engine.queue: is no more: engine=jobs 'engine.options={queue: NAME}'"):
        compose(["engine=ours"], tmp_path)
