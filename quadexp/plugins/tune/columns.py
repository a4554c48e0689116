"""Columns of a table of trials."""

from __future__ import annotations

from quadexp.log.schema import Column, Columns

TUNING: Columns = {
    "trial": Column("1", "", "number of the trial; 0 is the option as it is"),
    "flights": Column("1", "", "flights up to and with this trial"),
    "value": Column("1", "", "objective, the smaller the better (quadexp/plugins/tune/objective.py)"),
    "best": Column("1", "", "smallest objective so far"),
    "error": Column("m", "", "geometric mean of the flights' errors, of those that completed"),
    "lost": Column("1", "", "flights that were not completed"),
    "margin": Column("s", "", "smallest delay margin found"),
}
COLUMNS = {"tuning": TUNING}
