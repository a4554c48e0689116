"""The small files of an exported folder, each of a text with gaps: header, reference, building, README."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from quadexp.experiment.rollout import SampledReference
from quadexp.physics.state import N_STATE
from quadexp.plugins.vehicle.arrays import span
from quadexp.plugins.vehicle.generate import CHANGEABLE, FLOAT, HERE, Program

SOURCES = ("controller.c", "model.c", "mpc.c", "node.c", "table.c")
FOLLOWED = 19  # numbers of path and heading at an instant
FIRST_STEP = (
    "- The first step of a flight makes full steps only: from far away the bench also searches along the line.\n"
)


def filled(name: str, values: Mapping[str, object]) -> str:
    """The file `name`.in of this folder, with values for its @KEYS@."""
    text = (HERE / f"{name}.in").read_text(encoding="utf-8")
    return re.sub(r"@([A-Z]+)@", lambda key: str(values[key[1]]), text)


def named(exported: Program) -> dict[str, object]:
    """Values that most of them have."""
    names, controller = exported.names, exported.controller
    return {
        "PREFIX": names.prefix,
        "UPPER": names.upper,
        "REAL": names.real,
        "ROTORS": controller.vehicle.n_rotors,
        "ROWS": exported.rows,
        "STATES": N_STATE,
        "PERIOD": controller.control_period,
    }


def real_h(exported: Program) -> str:
    """Precision and names, before every other line of C."""
    functions = FLOAT.read_text(encoding="utf-8") if exported.names.real == "float" else ""
    return filled("real.h", named(exported) | {"FLOAT": functions})


def controller_h(exported: Program, about: Sequence[str], instants: int) -> str:
    """What the program around it includes. about: lines that say what it is. instants: of the recorded reference."""
    upper, place = exported.names.upper, exported.arrays.place
    changed = [f"#define {upper}_{name} {place(a)[1]} /* {a.size} numbers */" for name, a in changeable(exported)]
    values = {
        "SAID": "\n".join(f"   {line}" for line in about),
        "INPUTS": max(exported.rows - 1, 1),
        "TIMES": ", ".join(f"{t:.6g}" for t in exported.controller.node_times),
        "CHANGED": "\n".join(changed) or "/* none */",
        "INSTANTS": instants,
    }
    return filled("controller.h", named(exported) | values)


def table_c(exported: Program, reference: SampledReference) -> str:
    """The reference that is exported, a row an instant of its grid, with what each window takes of it."""
    literals, inputs_of = exported.names.literals, exported.controller.running.inputs
    states, inputs, where = reference.horizons()
    paths, headings = reference.path()
    starts = [span(array)[0] for array in (inputs_of.path, inputs_of.yaw)]
    called = [entry.function for entry in exported.calls if entry.function is not None]
    reads = {array.ctypes.data for function in called for array in function.arguments.values()}
    follows = any(first <= place < first + 8 * FOLLOWED for first in starts for place in reads)
    grid = np.column_stack([states, inputs])
    follow = np.column_stack([paths.reshape(len(paths), -1), headings])
    values = {
        "WIDTH": grid.shape[1],
        "GRID": ",\n".join(f"    {{{literals(row)}}}" for row in grid),
        "WHERE": ",\n".join(f"    {{{', '.join(map(str, row))}}}" for row in where.tolist()),
        "FOLLOWS": int(follows),
        "FOLLOWED": FOLLOWED,
        "FOLLOW": ",\n".join(f"    {{{literals(row)}}}" for row in follow if follows),
    }
    return filled("table.c", named(exported) | values)


def build_files(exported: Program, files: Collection[str]) -> dict[str, str]:
    """Makefile and CMakeLists.txt."""
    sources = " ".join(name for name in SOURCES if name in files)
    values = {"SOURCES": sources, "PLANT": "plant.c" if "plant.c" in files else "", "NAME": exported.names.prefix}
    return {name: filled(name, values) for name in ("Makefile", "CMakeLists.txt")}


def readme(exported: Program, about: Sequence[str], steps: int) -> str:
    """What the folder is, how it is used, and its limits. steps: of the recorded flight."""
    bytes_of = 8 if exported.names.real == "double" else 4
    sizes = {name: bytes_of * len(exported.arrays.contents(name)) for name in ("ram", "numbers", "rom")}
    sizes["sums"] = 8 * len(exported.arrays.contents("sums"))
    names = ", ".join(name for name, _ in changeable(exported))
    values = {
        "ABOUT": "\n".join(f"    {line}" for line in about),
        "SIZES": ", ".join(f"{name} {size / 1000:.1f} kB" for name, size in sizes.items()),
        "STEPS": steps,
        "CHANGEABLE": f"{names}, by `{exported.names.prefix}_numbers()`" if names else "nothing",
        "FIRST": f"{FIRST_STEP}\n" if exported.plan is not None else "",
    }
    return filled("README.md", named(exported) | values)


def changeable(exported: Program) -> list[tuple[str, np.ndarray]]:
    """Name and array of what a user may change, each once."""
    values = dict[str, np.ndarray]()
    seen = set[int]()
    arguments = [entry.function.arguments for entry in exported.calls if entry.function is not None]
    if exported.plan is not None:
        arguments.insert(0, exported.plan.mpc.step.arguments)
    for argument in arguments:
        for name, array in argument.items():
            known = name not in CHANGEABLE or not array.size or array.ctypes.data in seen
            if known or exported.arrays.place(array)[0] != "numbers":
                continue
            seen.add(array.ctypes.data)
            values[f"{name}_{len(values)}" if name in values else name] = array
    return list(values.items())
