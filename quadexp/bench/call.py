"""One call that flies and writes a leaderboard: what `quadexp bench` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from quadexp.bench.run import Leaderboard, run_bench
from quadexp.config.compose import session
from quadexp.errors import UsageError
from quadexp.sweeps.cluster.engines import opened

SETTABLE = ("engine", "evaluate")
CALLS = 64  # flights that an entry has at least in the larger sizes


def bench(
    overrides: Sequence[str] = (),
    *,
    size: str = "quick",
    out: Path | None = None,
    conf: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    **request: Any,
) -> Leaderboard:
    """Fly what is missing of the protocol, write the leaderboard, and return it.

    overrides: of the engine and its limits, such as "evaluate.workers=1". out: a folder, results/bench_SIZE by default.
    conf: a configuration folder of your own. progress: numbers of flights done and of all. request: controllers, only,
    add, seeds, version, page, target, say of `run_bench`. Raises UsageError before anything is flown.
    """
    for text in overrides:
        if text.partition("=")[0].partition(".")[0] not in SETTABLE:
            raise UsageError(f"{text!r}: what is flown is the protocol's; only {' and '.join(SETTABLE)} can be set")
    out = out or Path("results") / f"bench_{size}"
    with session(conf) as composer, opened(composer.compose(overrides), CALLS) as engine:
        return run_bench(composer, out, size=size, extra=conf, engine=engine, progress=progress, **request)
