"""Columns of a leaderboard, beside those of every kind of tables."""

from quadexp.log.schema import RESULT_COLUMNS

COLUMNS = {"leaderboard": RESULT_COLUMNS}
