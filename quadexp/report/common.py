"""Which flights are compared: the one rule of every table, statistic, figure and sentence on several controllers.

    trial      a flight that was asked for; one that nobody could fly (infeasible for all who were asked) is none
    flown      "k of n": of n trials, k ended well
    compared   whoever has k > 0
    common     the flights (condition, seed) that all who are compared ended well; as long as there is none, those with
               the smallest k are left out of the comparison

Means, intervals and tests that stand beside one another are over the common flights, so that they are of the same
paths and noise. What a controller flew beyond them stands beside it, with its count. Whoever flew least is never best.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Set
from typing import NamedTuple, TypeVar

Who = TypeVar("Who", bound=Hashable)
What = TypeVar("What", bound=Hashable)


class Flights(NamedTuple):
    """How many flights ended well, of how many trials."""

    ended: int
    trials: int

    @property
    def share(self) -> float:
        return self.ended / self.trials if self.trials else float("nan")

    def text(self) -> str:
        return f"{self.ended} of {self.trials}"


def common(ended: Mapping[Who, Set[What]]) -> tuple[list[Who], frozenset[What]]:
    """Who is compared, and the flights that all of them ended well.

    ended: who -> flights that ended well. Nobody is compared where no flight was ended well by anybody, or where those
    that are left have no flight in common.
    """
    compared = [who for who, flights in ended.items() if flights]
    while compared:
        shared = frozenset[What].intersection(*(frozenset(ended[who]) for who in compared))
        if shared:
            return compared, shared
        least = min(len(ended[who]) for who in compared)
        compared = [who for who in compared if len(ended[who]) > least]
    return [], frozenset()


def flew_least(flights: Mapping[Who, Flights]) -> frozenset[Who]:
    """Those with the smallest share of flights that ended well; nobody where all have the same."""
    shares = {who: one.share for who, one in flights.items() if one.trials}
    if not shares or max(shares.values()) == min(shares.values()):
        return frozenset()
    return frozenset(who for who, share in shares.items() if share == min(shares.values()))
