"""From a configuration to the remedies around its controller."""

from __future__ import annotations

import importlib
from typing import Any

from quadexp.config.schema import Config, remedies
from quadexp.errors import UsageError


def with_remedies(controller: Any, config: Config) -> Any:
    """The controller inside the remedies of a configuration; the controller itself where there are none.

    Raises UsageError where a remedy cannot be put around this controller, with what it needs.
    """
    for part in remedies(config).values():
        module, _, name = part.remedy.partition(":")
        try:
            controller = getattr(importlib.import_module(module), name)(controller, part)
        except UsageError as error:
            raise UsageError(f"controller={config.controller.name}: {error}") from None
    return controller
