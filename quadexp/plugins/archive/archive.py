"""A sweep as one zip file that flies again in an empty folder.

    README.md              what it is, and the commands: check, fly, compare
    SHA256SUMS             hash of every other file
    versions.txt           program, commit, libraries and processor that flew it
    citations.bib          the methods (quadexp show --cite)
    rerun/experiment/      the sweep as an experiment: every grid and every seed
    results/               rows, statistics, tables, figures; not the flights, which are flown again
    ...                    the user's --conf folders, checkpoints and files, where the sweep was given them

A file keeps its place relative to the folder in which the sweep was flown. One from outside of it is below `outside/`,
and the settings name it there.
"""

from __future__ import annotations

import io
import json
import shlex
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.names import distinct, sha256_of
from quadexp.parts.settings import read_value
from quadexp.plugins.archive.cite import bibtex
from quadexp.provenance import content_hash, folder_files
from quadexp.report.frame import read_results
from quadexp.report.pairing import Rows
from quadexp.report.text import count
from quadexp.writer import check_output, written

RERUN = "rerun"  # the folder of configuration that holds the sweep
CODE = (".py", ".yaml", ".yml", ".bib")  # of a --conf folder; data that flights read are in the record
SKIPPED = ("cells", "site-packages", "node_modules")
WHEN = (1980, 1, 1, 0, 0, 0)  # of every file inside: the same results are the same bytes


def write_archive(results: str | Path, out: str | Path, *, force: bool = False) -> dict[str, int]:
    """Write the archive of a results folder; returns its files with their sizes.

    Raises UsageError where the folder holds no sweep or says too little of it, DataError where a file that it read has
    changed or is gone."""
    path = check_output(out, force=force)
    root, rows, record = read_results(results)
    if "folder" not in record or not record.get("grids"):
        raise UsageError(f"{results}: does not say what was asked for: fly it again with quadexp evaluate --sweep")
    places = Places(Path(record["folder"]))
    files = dict(_inputs(record, places))
    conf = [places.of(Path(folder)) for folder in record.get("conf", ())]
    for folder in record.get("conf", ()):
        files |= {places.of(file): file.read_bytes() for file in _code(Path(folder))}
    names = []
    for name, text in experiments(record, places).items():
        files[f"{RERUN}/experiment/{name}.yaml"] = text.encode()
        names.append(name)
    members = [file for file in folder_files(root) if not {*SKIPPED}.intersection(file.relative_to(root).parts)]
    files |= {f"results/{file.relative_to(root).as_posix()}": file.read_bytes() for file in members if _is_result(file)}
    files["citations.bib"] = bibtex(root).encode()
    files["versions.txt"] = versions_text(record).encode()
    files["README.md"] = readme(rows, [RERUN, *conf], names).encode()
    sums = (f"{sha256_of(content)}  {name}\n" for name, content in sorted(files.items()))
    files["SHA256SUMS"] = "".join(sums).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, WHEN), content, zipfile.ZIP_DEFLATED)
    with written(path, force=force) as file:
        file.write(packed.getvalue())
    return {name: len(content) for name, content in sorted(files.items())}


class Places:
    """Where a file of the sweep is in the archive. folder: in which it was flown."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._outside: dict[Path, str] = {}  # folder -> its name in the archive

    def of(self, path: Path) -> str:
        """The place of a file or folder, relative to the archive."""
        path = self.folder / path
        if path.is_relative_to(self.folder):
            return path.relative_to(self.folder).as_posix()
        for above, name in self._outside.items():
            if path.is_relative_to(above):
                return f"{name}/{path.relative_to(above).as_posix()}".removesuffix("/.")
        above = path if path.is_dir() else path.parent
        self._outside[above] = f"outside/{len(self._outside)}_{above.name}"
        return self.of(path)

    def value(self, value: Any) -> Any:
        """A value of a setting; what of it names a file, or a checkpoint, as it is named in the archive."""
        if isinstance(value, list):
            return [self.value(each) for each in value]
        if not isinstance(value, str) or not value:
            return value
        path = self.folder / value
        if path.is_file() or (path / "model.json").is_file():
            return self.of(path)
        return value


def _inputs(record: Mapping[str, Any], places: Places) -> Iterator[tuple[str, bytes]]:
    """Every file that the flights read, as it was then."""
    for folder in record.get("conf", ()):
        places.of(Path(folder))  # before single files in it
    for name, digest in record.get("files", {}).items():
        path = Path(name)
        if not path.is_file():
            raise DataError(f"{path}: the sweep read this file, and it is gone: fly it again, then archive it")
        if content_hash(path) != digest:
            raise DataError(f"{path}: has changed since the sweep read it: fly it again, then archive it")
        yield places.of(path), path.read_bytes()


def _code(folder: Path) -> Iterator[Path]:
    """The options and modules in a --conf folder."""
    for path in folder_files(folder):
        parts = path.relative_to(folder).parts
        hidden = any(part.startswith(".") or part in SKIPPED for part in parts)
        if path.suffix in CODE and not hidden:
            yield path


def _is_result(path: Path) -> bool:
    return path.suffix in (".parquet", ".csv", ".md", ".tex", ".png", ".svg", ".pdf", ".html")


def experiments(record: Mapping[str, Any], places: Places) -> dict[str, str]:
    """Name -> text of the files that ask for the sweep again: one, or one for each experiment that it was of."""
    grids: dict[str, list[dict[str, list[Any]]]] = {}
    for axes in record["grids"]:
        grid: dict[str, list[Any]] = {}
        base = ""
        for axis in axes:
            key, values = _axis(axis, places)
            if key == "experiment":
                base = str(values[0])
            else:
                grid[key] = values
        grids.setdefault(base, []).append(grid)
    evaluate = {name: record[name] for name in ("metric", "baseline", "confidence")}
    texts = {}
    for base, several in grids.items():
        head = f"defaults: [{base}, _self_]\n" if base else ""
        sweep = "".join(f"  - {json.dumps(grid)}\n" for grid in several)
        name = f"archived_{base}" if base else "archived"
        texts[name] = f"# @package _global_\n{head}evaluate: {json.dumps(evaluate)}\nsweep:\n{sweep}"
    return texts


def _axis(axis: Sequence[str], places: Places) -> tuple[str, list[Any]]:
    """The key and the values of one axis of a grid."""
    key = axis[0].partition("=")[0]
    values = []
    for override in axis:
        values.append(places.value(read_value(override.partition("=")[2])))
    return key, values


def versions_text(record: Mapping[str, Any]) -> str:
    """What flew it, a line each."""
    provenance = record.get("provenance", {})
    git = provenance.get("git") or {}
    lines = [
        f"{flown['cells']} flights: quadexp {flown['program']}, sources {flown['sources']}, {flown['libraries']}"
        for flown in record.get("flown_by", ())
    ]
    if git:
        lines.append(f"commit {git['commit']}" + (" with changes" if git.get("dirty") else ""))
    lines += [f"{name} {provenance[name]}" for name in ("platform", "cpu", "created") if name in provenance]
    return "\n".join(lines) + "\n"


def readme(rows: Rows, conf: Iterable[str], names: Sequence[str]) -> str:
    """What the archive is, and its commands; each runs in the folder that it is unpacked into."""
    folders = []
    for folder in distinct(conf):
        folders += ["--conf", folder]
    fly = ["quadexp", "evaluate", "--sweep", *folders, f"experiment={','.join(names)}", "--out", "results_again"]
    seeds = sorted({row["seed"] for row in rows})
    controllers = ", ".join(distinct(str(row["controller"]) for row in rows))
    return f"""# Flights, archived

{count(len(rows), "flight")} of {controllers}; seeds {", ".join(map(str, seeds))}. `results/table.md` is the table,
`results/results.csv` has a row a flight, `versions.txt` what flew it, `citations.bib` the papers of its methods.

With quadexp of that version (see `versions.txt`) on the `PATH`, in this folder:

    sha256sum --check --quiet SHA256SUMS
    {shlex.join(fly)}
    quadexp compare results results_again

The first (on macOS `shasum -a 256 --check SHA256SUMS`) says nothing where every file is as it was packed. The last
compares the two sweeps: on the same kind of processor, with the same libraries, all numbers but wall times are equal to
the last digit; elsewhere to rounding.
"""
