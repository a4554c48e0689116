"""Mutation check: are wrong signs and constants in the dynamics and the control step noticed by the tests?

    python -m tests.mutation.mutate --sample 20 --seed 0        # a drawn sample
    python -m tests.mutation.mutate                             # all; takes hours, goes on where it was interrupted
    python -m tests.mutation.mutate --list                      # what would be changed
    python -m tests.mutation.mutate --retry survived            # after new tests: the survivors once more

Every mutant is one change (see operators.py) in a copy of the package, never in place; the fast tests of targets.py run
against the copy until the first failure: interpreted, but compiled where what was changed is C (operators_c.py), or
what only compiled code contains. A survivor is a gap in the tests unless accepted.toml gives the reason why its change
is none. Exit status 1 where an unexplained mutant survives.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter
from contextlib import suppress
from pathlib import Path

from tests.mutation.operators import Mutant, mutants
from tests.mutation.operators_c import c_mutants
from tests.mutation.targets import fast_tests, runs_compiled, target_files

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("quadexp", "tests", "conf", "benchmarks", "pyproject.toml", "README.md")
OUTCOMES = {0: "survived", 1: "killed", 2: "killed", 3: "error", 4: "killed", 5: "error"}  # of pytest; 4: no import
TIMEOUT = 300.0  # s


def main() -> int:
    """Run the check as the command line asks; see the module's docstring."""
    options = _options()
    chosen = [m for file in target_files(ROOT) if not options.only or any(part in file for part in options.only)
              for m in mutants_of(file)]  # fmt: skip
    accepted = accepted_reasons()
    if options.list:
        for mutant in chosen:
            print(f"{'accepted ' if mutant.key in accepted else ''}{mutant.key}")
        print(f"{len(chosen)} mutants in {len({m.file for m in chosen})} files, {len(accepted)} accepted survivors")
        return 0
    if options.sample:
        chosen = random.Random(options.seed).sample(chosen, min(options.sample, len(chosen)))
    done = _earlier(options.results)
    if options.retry:
        again = {record["key"] for record in done.values() if record["outcome"] in options.retry}
        chosen = [mutant for mutant in chosen if mutant.key in again and mutant.key not in accepted]
        done = {}
    waiting = [mutant for mutant in chosen if _fingerprint(mutant) not in done]
    print(f"{len(chosen)} mutants, {len(chosen) - len(waiting)} of them done before", flush=True)
    with tempfile.TemporaryDirectory(prefix="quadexp-mutants-") as scratch:
        _run(waiting, Path(scratch), options, done)
    return _report([done[_fingerprint(m)] for m in chosen if _fingerprint(m) in done], accepted)


def mutants_of(file: str) -> list[Mutant]:
    """All mutants of a file of the repository."""
    return (c_mutants if file.endswith(".c") else mutants)(file, (ROOT / file).read_text())


def accepted_reasons() -> dict[str, str]:
    """Survivors that are no gap, by key, with the reason."""
    entries = tomllib.loads((Path(__file__).parent / "accepted.toml").read_text()).get("accepted", [])
    return {key: entry["reason"] for entry in entries for key in entry["mutants"]}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", type=int, default=0, help="mutants to draw; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the drawing")
    parser.add_argument("--only", nargs="*", help="parts of file names")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="at a time")
    parser.add_argument("--results", type=Path, default=ROOT / "results/mutation.jsonl", help="where outcomes are kept")
    parser.add_argument("--retry", nargs="*", default=[], metavar="OUTCOME", help="only what ended so, again")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no new mutant after this time")
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    return parser.parse_args()


def _fingerprint(mutant: Mutant) -> str:
    """One for the changed file and the change."""
    return hashlib.sha256(f"{mutant.key}\n{mutant.source}".encode()).hexdigest()[:20]


def _earlier(results: Path) -> dict[str, dict]:
    """Records by fingerprint; of several the last."""
    done = {}
    if results.exists():
        for line in results.read_text().splitlines():
            with suppress(json.JSONDecodeError):  # a line cut off by an interruption
                record = json.loads(line)
                done[record["fingerprint"]] = record
    return done


def _run(waiting: list[Mutant], scratch: Path, options: argparse.Namespace, done: dict[str, dict]) -> None:
    """Test the mutants, `jobs` at a time, each slot in a folder of its own; outcomes are appended as they come."""
    options.results.parent.mkdir(parents=True, exist_ok=True)
    for module in ("casadi", "hypothesis", "numpy", "pytest", "scipy.integrate", "scipy.spatial.transform"):
        __import__(module)  # once, here; every mutant is a fork of this process
    folders = [_copy(scratch / f"slot{i}") for i in range(options.jobs)]
    _check_unchanged(sorted({test for mutant in waiting for test in fast_tests(mutant.file, folders[0])}), folders[0])
    running: dict[Path, tuple] = {}
    queue, began = list(waiting), time.monotonic()
    while queue or running:
        for folder in [f for f in folders if f not in running]:
            if not queue or time.monotonic() - began > options.seconds:
                queue = []
                break
            mutant = queue.pop(0)
            (folder / mutant.file).write_text(mutant.source)
            running[folder] = (mutant, _started(folder, fast_tests(mutant.file, folder), mutant.file), time.monotonic())
        time.sleep(0.05)
        for folder, (mutant, process, start) in list(running.items()):
            seconds = time.monotonic() - start
            if process.is_alive() and seconds < TIMEOUT:
                continue
            outcome, by = _outcome(process, folder)
            shutil.copy(folder / "original" / mutant.file, folder / mutant.file)
            del running[folder]
            record = {"fingerprint": _fingerprint(mutant), "key": mutant.key, "file": mutant.file}
            record |= {"line": mutant.line, "outcome": outcome, "by": by, "seconds": round(seconds, 1)}
            done[record["fingerprint"]] = record
            with options.results.open("a") as file:
                file.write(json.dumps(record) + "\n")
            print(f"{outcome:9s}{seconds:6.1f} s  {mutant.file}:{mutant.line}  {mutant.key}  {by}", flush=True)


def _check_unchanged(tests: list[str], folder: Path) -> None:
    """Exit where the tests fail without any change: then they prove nothing."""
    process = _started(folder, tests) if tests else None
    if process is None:
        return
    process.join()
    outcome, by = _outcome(process, folder)
    if outcome != "survived":
        print((folder / "output.txt").read_text()[-3000:])
        sys.exit(f"the tests fail without any mutant: {by}")


def _started(folder: Path, tests: list[str], changed: str = ""):
    compiled = runs_compiled(changed)
    process = multiprocessing.get_context("fork").Process(target=_pytest, args=(folder, tests, compiled))
    process.start()
    return process


def _copy(folder: Path) -> Path:
    """The repository's code in a folder, and once more in `original` below it."""
    for target in (folder, folder / "original"):
        target.mkdir(parents=True)
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, target / name, ignore=shutil.ignore_patterns("__pycache__"))
            elif source.exists():
                shutil.copy(source, target / name)
    return folder


def _pytest(folder: Path, tests: list[str], compiled: bool) -> None:
    """In a forked process: the tests against the copy, up to the first failure; the exit status is pytest's."""
    os.setsid()
    os.chdir(folder)
    with open("output.txt", "wb", buffering=0) as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    os.environ |= {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    if compiled:
        tempfile.tempdir = str(folder)  # where the tests keep what they compile
    else:
        os.environ["CC"] = "none"
    sys.dont_write_bytecode = True
    for name in [name for name in sys.modules if name.split(".")[0] in ("quadexp", "tests")]:
        del sys.modules[name]
    sys.path.insert(0, str(folder))
    import pytest

    status = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--no-header", "-m", "not slow", *tests]))
    import quadexp

    if not Path(quadexp.__file__).is_relative_to(folder):
        status = 3  # another package was tested
    os._exit(status)


def _outcome(process, folder: Path) -> tuple[str, str]:
    """What happened, and the first test that failed."""
    if process.is_alive():
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.join()
        return "timeout", ""
    text = (folder / "output.txt").read_text(errors="replace") if (folder / "output.txt").exists() else ""
    by = next((line.split(" - ")[0] for line in text.splitlines() if line.startswith(("FAILED", "ERROR"))), "")
    return OUTCOMES.get(process.exitcode, "killed"), by.strip()


def _report(records: list[dict], accepted: dict[str, str]) -> int:
    """Print the table and the survivors; 1 where one is not accepted."""
    print(f"\n{'file':44s} mutants  killed  accepted  survived")
    unexplained = [r for r in records if r["outcome"] == "survived" and r["key"] not in accepted]
    totals: Counter = Counter()
    for file in sorted({r["file"] for r in records}):
        of_file = [r for r in records if r["file"] == file]
        survived = sum(r in unexplained for r in of_file)
        explained = sum(r["outcome"] == "survived" for r in of_file) - survived
        row = (len(of_file), len(of_file) - survived - explained, explained, survived)
        totals.update(dict(enumerate(row)))
        print(f"{file:44s} {row[0]:7d} {row[1]:7d} {row[2]:9d} {row[3]:9d}")
    counts = Counter(r["outcome"] for r in records)
    print(f"{'all':44s} {totals[0]:7d} {totals[1]:7d} {totals[2]:9d} {totals[3]:9d}")
    print(f"killed by time-out {counts['timeout']}, tests that could not run {counts['error']}")
    for record in unexplained:
        print(f"SURVIVED {record['file']}:{record['line']}  {record['key']}")
    return 1 if unexplained or counts["error"] else 0


if __name__ == "__main__":
    sys.exit(main())
