"""The content of a file: kind, configuration, units, seed, versions, size, on one screen; and a flight's result."""

from __future__ import annotations

import json
import math
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import describe
from quadexp.log.store import check_finite, read_metadata, read_table
from quadexp.names import distinct
from quadexp.parts.schema import WORLD
from quadexp.plugin import brought
from quadexp.report.checked import flown_by, flown_by_lines, versions_of
from quadexp.report.frame import RESULTS
from quadexp.report.metrics import METRICS, declare_record, errors_none, from_columns
from quadexp.report.notes import LARGE_HEADING_ERROR, outside_line, range_lines
from quadexp.report.pairing import causes_text, grouped
from quadexp.report.table import Table, records_table
from quadexp.report.text import number, significant, speed_text

MODEL_FILE = "model.json"
WEAK_YAW = 0.501  # share of the weight on yaw, from which on down it is said: headings of 90 degrees and more
HELD_OUT_UNITS = {"a": "m/s^2", "t": "N m"}  # by the first letter of an output


def summarise(path: str | Path) -> dict[str, Any]:
    """The summary of a flight, data set, checkpoint folder, or results (file or folder); `lines` is for people.

    Raises UsageError if there is no such file, DataError if it is none of these or damaged.
    """
    path = Path(path)
    if kind_of(path) == "checkpoint":
        return _checkpoint(path.parent if path.name == MODEL_FILE else path)
    return _table(path / RESULTS if path.is_dir() else path)


def kind_of(path: Path) -> str:
    """ "flight", "results", "checkpoint", or another kind that the file records."""
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    if path.name == MODEL_FILE or (path / MODEL_FILE).is_file():
        return "checkpoint"
    if not path.is_dir():
        return read_metadata(path)["kind"]
    if not (path / RESULTS).is_file():
        raise UsageError(f"{path}: neither a checkpoint ({MODEL_FILE}) nor results ({RESULTS}) in this folder")
    return "results"


def flight_lines(metadata: Mapping[str, Any], *, always: bool = False) -> list[str]:
    """The result of one flight. always: also a line on a flight that stayed inside its model's data."""
    row = metadata["row"] | errors_none(metadata["row"]["outcome"])
    residual = metadata.get("residual", {})
    name = residual.get("name", "?")
    source = f" from {residual['source']}" if residual.get("source") else ""
    speed = f" at {text}" if (text := speed_text(row["speed"])) else ""
    about = f"{row['controller']} (residual: {name}{source}) flew {row['trajectory']}{speed}"
    cause = f" ({metadata['cause']})" if metadata.get("cause") else ""
    means = {"mean": row["mean_error"], "RMSE": row["rmse"], "max": row["max_error"]}
    errors = ", ".join(f"{kind} {1e3 * error:.4g} mm" for kind, error in means.items())
    errors += f", attitude {np.degrees(row['attitude_rmse']):.3g} deg"
    median, p99, largest = (significant(1e6 * row[f"solve_time_{kind}"], 0) for kind in ("median", "p99", "max"))
    lines = [
        f"{about} on {row['plant']}, seed {row['seed']}",
        f"outcome     {row['outcome']}{cause}",
        f"error       {errors if row['outcome'] in COMPLETED else 'none: it was not flown to its end'}",
    ]
    if (row.get("heading_rmse") or 0.0) > LARGE_HEADING_ERROR:
        lines.append("            the heading is far from the reference's, which an error of position does not show")
    if (share := metadata.get("yaw_share", 1.0)) < WEAK_YAW:
        heading = f"of the weight on yaw {100 * share:.0f} % acts at headings of this path"
        lines.append(f"heading     {heading}; with controller.attitude_error=body all of it")
    lines.append(f"step        median {median} us, 99 % {p99} us, largest {largest} us ({row['backend']})")
    if row.get("unconverged_count"):
        lines.append("            the first step did not converge (controller.initial_iterations): not the optimum")
    lines.append(
        f"flight      {row['duration']:.2f} s, peak speed {row['peak_speed']:.2f} m/s,"
        f" {100 * row['saturated_share']:.1f} % of samples at a thrust limit"
    )
    if (change := row.get("command_change")) is not None and math.isfinite(change):
        used = row.get("charge_used")
        battery = f", {100 * used:.0f} % of the battery used" if used is not None and math.isfinite(used) else ""
        lines.append(f"            a command changes by {100 * change:.2g} % of its range a step (RMS){battery}")
    if thinned := metadata.get("thinned"):
        every = thinned["log_period"]
        period = thinned["control_period"]
        lines.append(f"stored      a sample every {every:g} s, not every {period:g} s")
    of_margins = brought("services", "margin_texts")
    if of_margins and (line := of_margins.margin_line(metadata.get("margins"))):
        lines.append(f"loop        {line}")
    lines += [f"{'' if i else 'auto':<12}{line}" for i, line in enumerate(metadata.get("lacking", ()))]
    share = row.get("reference_residual")
    if share is not None and share < 1:
        contained = f"{math.floor(100 * share)} % of the residual ({name})"
        lines.append(f"reference   contains {contained}: with all of it no reference was found on this path")
    return lines + outside_line(metadata.get("outside_data"), always=always)


def _world_options(record: Mapping[str, Any]) -> list[str]:
    """The parts of a flight's world that do something, such as "wind=gust"; a flight records no others."""
    config = record.get("config") or {}
    names = {group: config[group].get("name") for group in WORLD if isinstance(config.get(group), Mapping)}
    return [f"{group}={name}" for group, name in names.items() if (group, name) != ("sensor", "perfect")]


def _table(path: Path) -> dict[str, Any]:
    record = read_metadata(path)
    kind = record["kind"]
    columns, _ = read_table(path, kind)
    rows = len(next(iter(columns.values()))) if columns else 0
    size = path.stat().st_size
    summary = {
        "path": str(path), "kind": kind, "schema": record["schema"], "rows": rows, "bytes": size,
        "columns": {name: describe(name, kind)._asdict() for name in columns}, "config": record.get("config"),
        "seed": record.get("seed"), "versions": record.get("versions", {}), "sources": record.get("sources", ""),
        "provenance": record.get("provenance", {}),
    }  # fmt: skip
    lines = [f"{path}: {kind}, {rows} rows, {len(columns)} columns, {_size(size)}"]
    if kind == "flight" and "row" in record:
        lines += _flight_lines(record, rows, summary)
    elif kind == "flight" and record.get("recorded"):
        of_log = brought("services", "recorded_lines")
        lines += of_log(record, columns, summary) if of_log else []
    elif kind == "residuals":
        lines += _residual_lines(record, columns, summary)
    elif kind == "results":
        lines += _result_lines(record, columns, summary)
    lines += _config_lines(record.get("config"))
    if kind == "results":  # the versions of the flights are in the rows; those of the record are of the table
        created = summary["provenance"].get("created")
        written = f"table       written {created}, {revision_text(summary['provenance'])}".rstrip(", ")
        return summary | {"lines": lines + ([written] if created else [])}
    lines += _unit_lines(summary["columns"]) + _provenance_lines(record)
    return summary | {"lines": lines}


def _flight_lines(record: Mapping[str, Any], samples: int, summary: dict[str, Any]) -> list[str]:
    outcome = record.get("outcome")
    world = record.get("world")
    parts = _world_options(record)
    row = record["row"] | errors_none(outcome)
    metrics = {name: row.get(name) for name in METRICS}
    table = [{"figure": name, "value": metrics[name], "unit": describe(name, "results").unit} for name in METRICS]
    summary |= {"metrics": metrics, "outcome": outcome, "tables": [records_table(table)]}
    summary["world"] = {"name": world, "parts": parts}
    lines = flight_lines(record, always=True) if samples else [f"outcome     {outcome}: {record.get('cause')}"]
    beside = "" if ",".join(parts) in ("", world) else f": {', '.join(parts)}"
    lines += [f"world       {world}{beside}"] if world else []
    summary["classes"] = record.get("classes", {})
    return lines + [f"class       {group}: {name}" for group, name in summary["classes"].items()]


def _residual_lines(record: Mapping[str, Any], columns: Mapping[str, np.ndarray], summary: dict[str, Any]) -> list[str]:
    vehicle = record.get("vehicle", {})
    flights = record.get("flights", [])
    lines = [
        f"vehicle     {vehicle.get('name')} ({vehicle.get('fingerprint')}), frame {record.get('frame')}",
        f"flights     {len(flights)}, {float(np.sum(columns['dt'])):.0f} s",
    ]
    check_finite(columns, [name for name in columns if columns[name].dtype.kind == "f"], "data set")
    rows = []
    for name in ("v_x", "v_y", "v_z", "a_x", "a_y", "a_z"):
        numbers = {kind: float(getattr(columns[name], kind)()) for kind in ("mean", "std", "min", "max")}
        rows.append({"column": name, **numbers, "unit": _unit(name)})
        text = "  ".join(f"{kind} {value:8.3f}" for kind, value in numbers.items())
        lines.append(f"{name:<12}{text} {_unit(name)}")
    summary |= {"flights": flights, "tables": [records_table(rows)]}
    return lines


def _result_lines(record: Mapping[str, Any], columns: Mapping[str, np.ndarray], summary: dict[str, Any]) -> list[str]:
    from quadexp.report.tables import error_table

    declare_record(record)
    rows = from_columns(columns)
    summary |= {"versions": versions_of(rows), "flown_by": flown_by(rows)}
    outcomes = Counter(row["outcome"] for row in rows)
    lines = [f"outcomes    {causes_text(outcomes)}"]
    lines += flown_by_lines(rows)
    if rows:
        options = {name: record[name] for name in ("baseline", "confidence") if name in record}
        table = error_table(rows, record.get("metric", "mean_error"), **options)
        summary["tables"] = [table]
        lines += ["", *table.markdown().splitlines(), ""]
    return lines


def held_out_rows(checkpoint: str | Path) -> list[dict[str, Any]]:
    """How well each predictor does on flights that no fit has seen: a record for each output and predictor, with rmse
    and its unit; [] where the checkpoint has no report, or one of another kind."""
    from quadexp.models.checkpoint import load_report

    path = Path(checkpoint)
    try:
        rows = load_report(path.parent if path.name == MODEL_FILE else path).get("rows", [])
        return [{**row, "unit": HELD_OUT_UNITS[row["output"][0]], "rmse": float(row["rmse"])} for row in rows]
    except (QuadexpError, ValueError, TypeError, KeyError, AttributeError):  # a model does not need its report
        return []


def held_out_table(rows: Sequence[Mapping[str, Any]]) -> Table | None:
    """Outputs down, predictors across; None without scores."""
    if not rows:
        return None
    errors: dict[str, dict[str, str]] = {}
    for row in rows:
        errors.setdefault(f"{row['output']} ({row['unit']})", {})[row["predictor"]] = number(row["rmse"])
    predictors = distinct(row["predictor"] for row in rows)
    lines = [[output, *(texts.get(predictor, "-") for predictor in predictors)] for output, texts in errors.items()]
    return Table(["RMSE on held-out flights", *predictors], lines)


def _checkpoint(path: Path) -> dict[str, Any]:
    from quadexp.models.checkpoint import edited_note, load_model, load_report

    model = load_model(path)
    file = path / MODEL_FILE
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{file}: damaged ({error})") from None
    data = dict(model.dataset)
    about, described = model.described(lambda: load_report(path))
    summary = {
        "path": str(path), "kind": model.kind, "schema": record.get("schema"), "bytes": file.stat().st_size,
        "vehicle": dict(model.vehicle), "dataset": data, "settings": dict(getattr(model, "settings", {})),
        "versions": dict(getattr(model, "versions", {}) or record.get("versions", {})),
        "drag": list(map(float, model.linear_drag.drag)), "outputs": {}, **about,
        "feature_range": dict(model.feature_range), "held_out": held_out_rows(path),
    }  # fmt: skip
    lines = [
        f"{path}: checkpoint, {summary['kind']}, {_size(summary['bytes'])}",
        f"vehicle     {model.vehicle.get('name')} ({model.vehicle.get('fingerprint')})",
        f"data        {data.get('rows')} rows of {data.get('flights')} flights, sha256 {str(data.get('sha256'))[:12]}",
    ]
    lines += [f"warning: {edited}"] if (edited := edited_note(path)) else []
    lines += described
    lines += range_lines(model.feature_range)
    if (scores := held_out_table(summary["held_out"])) is not None:
        lines += scores.lines()
        summary["tables"] = [scores]
    else:
        lines.append("held out    unknown: no scores stand beside this checkpoint")
    if settings := [f"{name} {value}" for name, value in summary["settings"].items() if name != "features"]:
        lines.append(f"settings    {', '.join(settings)}")
    return summary | {"lines": lines + _provenance_lines(summary)}


def _unit(output: str) -> str:
    return describe(output, "residuals").unit


def _config_lines(config: Mapping[str, Any] | None) -> list[str]:
    """The configuration, a line per group."""
    lines = []
    for group, values in (config or {}).items():
        if not isinstance(values, Mapping):
            lines.append(f"{group:<12}{'none' if values is None else values}")
            continue
        small = [f"{k} {_short(v)}" for k, v in values.items() if k not in ("name", "kind", "models") and v is not None]
        text = ", ".join(small) if group != "vehicle" else f"mass {values.get('mass')} kg"
        text = f"{values['name']}: {text}" if values.get("name") else text
        lines += textwrap.wrap(text, 110, initial_indent=f"{group:<12}", subsequent_indent=" " * 12)
    return lines


def _short(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_short, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _unit_lines(columns: Mapping[str, Mapping[str, str]]) -> list[str]:
    """The columns, those of one unit and frame in one line."""
    units = {
        name: ", ".join(filter(None, (column["unit"] or "-", column["frame"]))) for name, column in columns.items()
    }
    groups = grouped((unit, name) for name, unit in units.items())
    return [f"columns     {' '.join(names)}  [{unit}]" for unit, names in groups.items()]


def _provenance_lines(record: Mapping[str, Any]) -> list[str]:
    provenance = record.get("provenance", {})
    versions = record.get("versions", {})
    lines = []
    if versions:
        lines.append("versions    " + ", ".join(f"{name} {version}" for name, version in versions.items()))
    if record.get("sources"):
        lines.append(f"sources     {record['sources']} (hash of what decides a flight)")
    if provenance:
        revision = revision_text(provenance)
        lines.append(f"made        {provenance.get('created')}, {revision and revision + ', '}{provenance.get('cpu')}")
    return lines


def revision_text(provenance: Mapping[str, Any]) -> str:
    """Such as "commit 6ff48bd8a4", with changes where there were some; "" where no checkout says."""
    git = provenance.get("git") or {}
    return f"commit {git['commit'][:10]}{' with changes' if git.get('dirty') else ''}" if git else ""


def _size(count: int) -> str:
    return f"{count / 1e6:.2f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"
