"""A configured controller, with the trajectory that it is checked on, as a folder of C that needs nothing of this
program."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.compiled_loop import goes_in_c
from quadexp.control.control_step import in_calls
from quadexp.control.wrapped import innermost, layers
from quadexp.errors import UsageError
from quadexp.experiment.build import (
    build_controller,
    build_trajectory,
    build_vehicle,
    build_world,
    check_remedies,
    unshared,
)
from quadexp.experiment.evaluate import generator
from quadexp.experiment.identity import find_model, flight_record
from quadexp.experiment.rollout import SampledReference
from quadexp.names import sha256_of
from quadexp.parts.compose import compose
from quadexp.parts.options import Folders
from quadexp.parts.schema import Config, remedies
from quadexp.plugins.vehicle import generate, tables, texts
from quadexp.plugins.vehicle.record import OF_LOOP, Recorder, compiled_period, recorded
from quadexp.plugins.vehicle.start import check_start, start_function
from quadexp.provenance import versions
from quadexp.writer import check_output, write_folder

MANIFEST = "model.json"
FORMAT = 4  # of the folder
REPLAY = {"double": 1e-9, "float": 0.02}  # N, of a step on recorded inputs
PATHS = {"double": 1e-9, "float": 1.0}  # m, between the path of the bench and that of C
ERRORS = {"double": 1e-6, "float": 0.01}  # share of the mean tracking error
ROUNDING = {"double": 1e-9, "float": 1e-5}  # m, beside that: hover has no error but what is rounded


def export_controller(
    overrides: Sequence[str],
    out: Path,
    conf: Folders = None,
    *,
    real: str = "double",
    prefix: str = "qx",
    force: bool = False,
) -> dict[str, Any]:
    """Write the folder. real: precision. prefix: of all names that other objects see.

    Raises UsageError for a controller that does not fly in C, and where `out` is taken.
    """
    if not prefix.isidentifier() or not prefix.isascii() or not prefix.islower():
        raise UsageError(f"--prefix {prefix}: must be small letters, digits and _, as of a name in C")
    path = check_output(out, force=force, folder=True)
    config = compose(list(overrides), conf, "export-controller")
    with unshared():
        vehicle = build_vehicle(config.vehicle)
        plant = build_world(config, vehicle)
        check_remedies(config, vehicle, plant)
        controller = build_controller(config, vehicle, plant, find_model(config))
        refuse_python(controller, config)
        reference = SampledReference(build_trajectory(config.trajectory, vehicle), controller)
        flight = recorded(controller, plant, reference, generator(config, flight_record(config)))
        files = folder_of(config, controller, plant, reference, flight, generate.Names(prefix, real))
    former = path / MANIFEST
    stale = manifest_names(former) - files.keys() if former.is_file() else set()
    write_folder(path, files, force=force)
    for name in stale:
        (path / name).unlink(missing_ok=True)
    return {"path": str(path), "files": {name: len(content) for name, content in files.items()}}


def manifest_names(file: Path) -> set[str]:
    """Files of an earlier export, none where it is something else."""
    try:
        return {Path(name).name for name in json.loads(file.read_text(encoding="utf-8"))["files"]}
    except (ValueError, KeyError, TypeError):
        return set()


def refuse_python(controller: Any, config: Config) -> None:
    """Raise UsageError where a controller, or a compensation, exists in Python only; it is named."""
    if in_calls(controller) and controller.backend != "compiled":
        raise UsageError("export-controller: needs a C compiler and backend=compiled, which the bench flies with too")
    around = [f"{group}={part.name}" for group, part in remedies(config).items()]
    inside = [innermost(controller), *reversed(layers(controller))]
    for place, layer in enumerate(inside):
        flies = in_calls(layer) and goes_in_c(layer)
        if flies and not any(o.kind == "python" for o in layer.running.control_step.calls):
            continue
        name = f"controller={config.controller.name}"
        if place:
            prefix = getattr(getattr(layer, "part", None), "prefix", "").rstrip(".")
            name = next((text for text in around if prefix and text.startswith(f"{prefix}=")), ", ".join(around))
        raise UsageError(f"export-controller: {name} decides or learns in Python, and has no form in C to be exported")


# ------------------------------------------------------------------------------------------------------------ the files
def folder_of(
    config: Config, controller: Any, plant: Any, reference: SampledReference, flight: Recorder, names: generate.Names
) -> dict[str, str | bytes]:
    """Name -> content of everything in the folder."""
    window = reference.window(0)
    start = start_function(controller, "begin")
    check_start(controller, *start, window)
    controller.reset(window.state[0] if len(window.state) else reference.at(0)[0], window)
    exported = generate.program(controller, names, start, hover_thrusts(controller))
    about = description(config, controller, names)
    functions = [function for _, function in generate.functions_of(exported).values()]
    functions += [start[0]] if start[0] is not None else []
    files: dict[str, str | bytes] = {
        "controller.h": texts.controller_h(exported, about, len(reference)),
        "controller.c": tables.controller_c(exported),
        "model.c": generate.model_c(exported, functions),
        "real.h": texts.real_h(exported),
        "table.c": texts.table_c(exported, reference),
    }
    copies = [generate.HERE / name for name in ("vehicle.c", "reference.c", "check.c")]
    copies += generate.KERNELS[:1]
    if exported.plan is not None:
        files |= {"mpc.c": generate.mpc_c(exported), "node.c": generate.node_c(exported)}
        copies += generate.KERNELS[1:]
    files |= {text.name: text.read_text(encoding="utf-8") for text in copies}
    files |= checked_files(exported, controller, plant, reference, flight)
    files |= texts.build_files(exported, files)
    files["README.md"] = texts.readme(exported, about, len(flight.rows))
    files |= manifest(config, controller, names, files)
    return files


def hover_thrusts(controller: Any) -> np.ndarray:
    """Thrusts that hold the vehicle level in still air, (n,) (N)."""
    vehicle = controller.vehicle
    wrench = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
    return np.clip(np.linalg.pinv(vehicle.allocation) @ wrench, vehicle.thrust_min, vehicle.thrust_max)


def learns(controller: Any) -> bool:
    """Whether it remembers its own commands: then a replay is not what it would have done."""
    return any("sent" in memory.sizes for memory in controller.running.control_step.memory)


def checked_files(
    exported: generate.Program, controller: Any, plant: Any, reference: SampledReference, flight: Recorder
) -> dict[str, str | bytes]:
    """The recorded flight, the plant, and what is to be met."""
    names = exported.names
    precision = np.dtype("<f8" if names.real == "double" else "<f4")
    files: dict[str, str | bytes] = {"vectors.bin": np.array(flight.rows).astype(precision).tobytes()}
    P, p = names.upper, names.prefix
    contexts = flight.contexts or []
    period = compiled_period(plant, controller.control_period) if contexts else None
    rows = [f"#define NAME(name) {p}_##name", f"enum {{ ROTORS = {P}_ROTORS, ROWS = {P}_ROWS }};"]
    rows += [f"#define REPLAYS {int(not learns(controller))}", f"#define REPLAY_LIMIT {REPLAY[names.real]!r} /* N */"]
    rows += [f"#define HAS_PLANT {int(period is not None)}"]
    if period is not None:
        function = period.function.origin
        start = reference.at(0)[0]
        along = np.array([row[:3] for row in reference.along()[0][: len(contexts)]])
        flown = np.array([start[:3], *flight.positions])[: len(contexts)]
        error = float(np.linalg.norm(flown - along, axis=1).mean())
        rows += plant_lines(function, period.arguments, plant, len(flight.first))
        rows += [f"#define PATH_LIMIT {PATHS[names.real]!r} /* m */", f"#define ERROR_SHARE {ERRORS[names.real]!r}"]
        rows += [f"#define ROUNDING {ROUNDING[names.real]!r} /* m */"]
        rows += [f"#define MEAN_ERROR {error!r} /* m */"]
        parts = [start, flight.first]
        for context, position in zip(contexts, flight.positions, strict=True):
            parts += [context, position]
        files["plant.bin"] = np.concatenate(parts).astype("<f8").tobytes()
        generator = ca.CodeGenerator("check_plant", {"with_header": False})
        generator.add(function)
        source = generate.HELPERS.sub("", generator.dump())
        files["plant.c"] = f"{generate.QUIET}#define {function.name()} check_plant\n{source}"
    files["check.h"] = "/* What check.c needs to know. */\n" + "\n".join(rows) + "\n"
    return files


def plant_lines(function: ca.Function, arguments: Mapping[str, np.ndarray], plant: Any, first: int) -> list[str]:
    """Sizes of the plant's period, and where its arguments and results lie in check.c."""
    inner = function.size1_in("inner")
    rotors = list(plant.rotor_places) if hasattr(plant, "rotor_speed") else []
    of_rotors = ", ".join(map(str, rotors or [0] * function.size1_in("u")))
    points, at = [], 0
    for i, (name, array) in enumerate(arguments.items()):
        if name in OF_LOOP:
            points.append(f"given[{i}] = {name};")
        elif array.size:
            points.append(f"given[{i}] = buffer + {at};")
            at += array.size
    places = {"x_next": "x_next", "inner_next": "inner_next", "specific_force": "reading", "measured": "told"}
    spare = 0
    for i, name in enumerate(function.name_out()):
        points.append(f"left[{i}] = {places.get(name, f'spare + {spare}')};")
        spare += 0 if name in places else function.nnz_out(i)
    measured, results = first - inner, function.sz_res()
    return [
        f"enum {{ INNER = {inner}, TOLD = {measured}, TURNS = {int(bool(rotors))}, PLANT_CONTEXT = {at} }};",
        f"enum {{ PLANT_SPARE = {spare}, PLANT_ARGUMENTS = {function.sz_arg()}, PLANT_RESULTS = {results} }};",
        f"enum {{ PLANT_W = {function.sz_w()}, PLANT_IW = {function.sz_iw()} }};",
        "#define PLANT_INTEGER long long",
        f"static const int turning[] = {{{of_rotors}}}; /* inner states */",
        f"#define PLANT_POINTERS {' '.join(points)}",
    ]


def description(config: Config, controller: Any, names: generate.Names) -> list[str]:
    """Lines about what is exported."""
    parts = [f"{group}={part.name}" for group, part in remedies(config).items()]
    model = f" model={config.model}" if config.model else ""
    fingerprint = controller.vehicle.fingerprint
    return [
        f"controller={config.controller.name}{model} {' '.join(parts)}".rstrip(),
        f"vehicle={config.vehicle.name} ({fingerprint}), {1 / controller.control_period:g} Hz, {names.real}",
        f"checked on trajectory={config.trajectory.name} plant={config.plant.name} world={config.world}",
    ]


def manifest(
    config: Config, controller: Any, names: generate.Names, files: Mapping[str, str | bytes]
) -> dict[str, str | bytes]:
    """What the bench needs to fly the folder: settings, versions, the hash of every file, and its own; and the model of
    the air of its references."""
    residual = controller.residual
    air: dict[str, Any] = {}
    if residual is not None:
        air = {"name": residual.name, "source": residual.source, "theta": residual.theta.tolist()}
        air["function"] = residual.function.serialize()
        air["ranges"] = {key: list(value) for key, value in (residual.ranges or {}).items()}
    content = {
        "exported": FORMAT,
        "prefix": names.prefix,
        "real": names.real,
        "config": flight_record(config),
        "vehicle": {"name": controller.vehicle.name, "fingerprint": controller.vehicle.fingerprint},
        "rotors": controller.vehicle.n_rotors,
        "period": controller.control_period,
        "node_times": [float(t) for t in controller.node_times],
        "knows": controller.residual_name,
        "source": controller.source,
        "air": air,
        "versions": versions(),
        "files": {name: sha256_of(content) for name, content in sorted(files.items())},
    }
    return {MANIFEST: as_text(content | {"sha256": sha256_of(as_text(content))})}


def as_text(content: Mapping[str, Any]) -> str:
    """The manifest, the same text for the same content."""
    return json.dumps(content, indent=1, sort_keys=True) + "\n"
