"""Columns of flights whose controller has a model that adapts."""

from __future__ import annotations

from quadexp.log.schema import each

FLIGHT = each("innovation", "m/s^2", "body", "residual acceleration less its prediction by the weights before it")
COLUMNS = {"flight": FLIGHT}
