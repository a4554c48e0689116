"""What is in a file: kind, configuration, units, seed, versions, size, on one screen."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import describe
from quadexp.log.store import check_finite, has_content_hash, read_metadata, read_table
from quadexp.report.flown_by import flown_by, flown_by_lines, versions_of
from quadexp.report.margin_line import margin_line
from quadexp.report.metrics import METRICS
from quadexp.report.notes import LARGE_ATTITUDE_ERROR

MODEL_FILE = "model.json"
RESULTS_FILE = "results.parquet"
SHOWN_COLUMNS = 40


def summarise(path: str | Path) -> dict[str, Any]:
    """The summary of a flight, data set, checkpoint folder, or results (file or folder); `lines` is for people.

    Raises UsageError where there is nothing, DataError where it is none of these or damaged.
    """
    path = Path(path)
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    if path.is_dir():
        if (path / RESULTS_FILE).is_file():
            return _table(path / RESULTS_FILE)
        if (path / MODEL_FILE).is_file():
            return _checkpoint(path)
        raise UsageError(f"{path}: neither a checkpoint ({MODEL_FILE}) nor results ({RESULTS_FILE}) in this folder")
    if path.name == MODEL_FILE:
        return _checkpoint(path.parent)
    return _table(path)


def flight_lines(metadata: Mapping[str, Any], *, always: bool = False) -> list[str]:
    """How one flight went, for people. always: also where it lay inside the data of the model that flew it."""
    from quadexp.report.outside import outside_line

    row, residual = metadata["row"], metadata.get("residual", {})
    knows = residual.get("name", "?")
    source = f" from {residual['source']}" if residual.get("source") else ""
    speed = "" if row["speed"] is None else f" at {row['speed']:g} m/s"
    lines = [
        (
            f"{row['controller']} (residual: {knows}{source}) flew {row['trajectory']}{speed}"
            f" on {row['plant']}, seed {row['seed']}"
        )
    ]
    cause = f" ({metadata['cause']})" if metadata.get("cause") else ""
    lines.append(f"outcome     {row['outcome']}{cause}")
    lines.append(
        f"error       mean {1e3 * row['mean_error']:.4g} mm, RMSE {1e3 * row['rmse']:.4g} mm,"
        f" max {1e3 * row['max_error']:.4g} mm, attitude {np.degrees(row['attitude_rmse']):.3g} deg"
    )
    if row["attitude_rmse"] > LARGE_ATTITUDE_ERROR:
        lines.append("            the attitude is far from the reference's, which an error of position does not show")
    lines.append(
        f"step        median {1e6 * row['solve_time_median']:.0f} us, 99 % {1e6 * row['solve_time_p99']:.0f} us,"
        f" largest {1e6 * row['solve_time_max']:.0f} us ({row['backend']})"
    )
    if row.get("unconverged_count"):
        lines.append("            the first step did not converge (controller.initial_iterations): not the optimum")
    lines.append(
        f"flight      {row['duration']:.2f} s, peak speed {row['peak_speed']:.2f} m/s,"
        f" {100 * row['saturated_share']:.1f} % of samples at a thrust limit"
    )
    if line := margin_line(metadata.get("margins")):
        lines.append(f"loop        {line}")
    share = row.get("reference_residual")
    if share is not None and share < 1:
        lines.append(
            f"reference   contains {math.floor(100 * share)} % of the residual ({knows}):"
            " with all of it none was found on this path"
        )
    return lines + outside_line(metadata.get("outside_data", _unknown(row)), always=always)


def _unknown(row: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a flight of an older version says of its model's data."""
    note = "flown by an older version"
    return {"model": row["model"], "share": None, "note": note} if row.get("model") else None


def _table(path: Path) -> dict[str, Any]:
    record = read_metadata(path)
    kind = record["kind"]
    columns, _ = read_table(path, kind)
    rows = len(next(iter(columns.values()))) if columns else 0
    summary: dict[str, Any] = {
        "path": str(path),
        "kind": kind,
        "schema": record["schema"],
        "rows": rows,
        "bytes": path.stat().st_size,
        "columns": {name: describe(name, kind)._asdict() for name in columns},
        "config": record.get("config"),
        "seed": record.get("seed"),
        "versions": record.get("versions", {}),
        "sources": record.get("sources", ""),
        "provenance": record.get("provenance", {}),
        "hashed": has_content_hash(path),
    }
    lines = [f"{path}: {kind}, {rows} rows, {len(columns)} columns, {_size(summary['bytes'])}"]
    if kind == "flight" and "row" in record:
        summary["metrics"] = {name: record["row"].get(name) for name in METRICS}
        summary["outcome"] = record.get("outcome")
        if rows:
            lines += flight_lines(record, always=True)
        else:
            lines.append(f"outcome     {record.get('outcome')}: {record.get('cause')}")
    elif kind == "flight" and record.get("recorded"):
        summary |= {"source": record.get("source"), "findings": record.get("findings", [])}
        lines += _recorded_lines(record, columns)
    elif kind == "residuals":
        summary["flights"] = record.get("flights", [])
        lines += _residual_lines(record, columns)
    elif kind == "results":
        from quadexp.report.tables import from_columns

        rows_of = from_columns(columns)
        summary |= {"versions": versions_of(rows_of), "flown_by": flown_by(rows_of)}
        lines += _result_lines(record, rows_of, path.parent)
    lines += _config_lines(record.get("config"))
    if kind == "results":  # the rows say who flew them; the record, who wrote the table
        created = summary["provenance"].get("created")
        lines += [f"table       written {created}"] if created else []
        return summary | {"lines": lines}
    lines += _unit_lines(summary["columns"])
    lines += _provenance_lines(record)
    if not summary["hashed"]:
        lines.append("hash        none of the columns: written by an earlier version, an edit would not be noticed")
    return summary | {"lines": lines}


def _recorded_lines(record: Mapping[str, Any], columns: Mapping[str, np.ndarray]) -> list[str]:
    """Where a recorded flight came from, and what the quality check said of it."""
    source, t = record.get("source", {}), columns["t"]
    file, form, rate = (source.get(key) for key in ("file", "format", "rate"))
    hertz = f" at {rate:.4g} Hz" if isinstance(rate, (int, float)) else ""
    lines = [f"recorded    {file} ({form}), {float(t[-1] - t[0]) if len(t) else 0.0:.1f} s{hertz}"]
    if all(name in columns for name in ("v_x", "v_y", "v_z")) and len(t):
        lines.append(f"peak speed  {float(np.sqrt(sum(columns[f'v_{i}'] ** 2 for i in 'xyz')).max()):.2f} m/s")
    return lines + [f"finding     {finding['message']}" for finding in record.get("findings", [])]


def _residual_lines(record: Mapping[str, Any], columns: Mapping[str, np.ndarray]) -> list[str]:
    vehicle = record.get("vehicle", {})
    flights = record.get("flights", [])
    lines = [
        f"vehicle     {vehicle.get('name')} ({vehicle.get('fingerprint')}), frame {record.get('frame')}",
        f"flights     {len(flights)}, {float(np.sum(columns['dt'])):.0f} s",
    ]
    check_finite(columns, [name for name in columns if columns[name].dtype.kind == "f"], "data set")
    for name in ("v_x", "v_y", "v_z", "a_x", "a_y", "a_z"):
        values = columns[name]
        lines.append(
            f"{name:<12}mean {values.mean():8.3f}  std {values.std():7.3f}"
            f"  min {values.min():8.3f}  max {values.max():8.3f} {describe(name, 'residuals').unit}"
        )
    return lines


def _result_lines(record: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], folder: Path) -> list[str]:
    from quadexp.report.statistics_file import comparison_texts, results_statistics
    from quadexp.report.tables import to_markdown

    outcomes: dict[str, int] = {}
    for row in rows:
        outcomes[row["outcome"]] = outcomes.get(row["outcome"], 0) + 1
    lines = ["outcomes    " + ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())]
    lines += flown_by_lines(rows)
    if rows:
        options = {name: record[name] for name in ("baseline", "confidence") if name in record}
        statistics, metric = results_statistics(folder, rows, **options), record.get("metric", "mean_error")
        table = comparison_texts(statistics, metric)[0]
        lines += ["", *to_markdown(table).splitlines(), ""]
    return lines


def _checkpoint(path: Path) -> dict[str, Any]:
    from quadexp.learn.checkpoint import KINDS, load_model, load_report
    from quadexp.learn.vehicle_model import VehicleModel
    from quadexp.report.outside import range_lines

    model = load_model(path)
    file = path / MODEL_FILE
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{file}: damaged ({error})") from None
    outputs = getattr(model, "outputs", ())
    summary: dict[str, Any] = {
        "path": str(path),
        "kind": KINDS[type(model)],
        "schema": record.get("schema"),
        "bytes": file.stat().st_size,
        "vehicle": dict(model.vehicle),
        "dataset": dict(model.dataset),
        "settings": dict(getattr(model, "settings", {})),
        "versions": dict(getattr(model, "versions", {}) or record.get("versions", {})),
        "drag": list(map(float, model.linear_drag.drag)),
        "outputs": {
            o.output: {
                "features": list(o.features),
                "inducing": len(o.alpha),
                "lengthscale": list(map(float, np.atleast_1d(o.lengthscale))),
                "signal_std": float(np.sqrt(o.signal_variance)),
                "noise_std": float(np.sqrt(o.noise_variance)),
            }
            for o in outputs
        },
    }
    dataset = summary["dataset"]
    lines = [
        f"{path}: checkpoint, {summary['kind']}, {_size(summary['bytes'])}",
        f"vehicle     {model.vehicle.get('name')} ({model.vehicle.get('fingerprint')})",
        (
            f"data        {dataset.get('rows')} rows of {dataset.get('flights')} flights,"
            f" sha256 {str(dataset.get('sha256'))[:12]}"
        ),
    ]
    for name, output in summary["outputs"].items():
        scales = ", ".join(f"{f} {s:.3g}" for f, s in zip(output["features"], output["lengthscale"], strict=True))
        lines.append(
            f"{name:<12}{output['inducing']} points, length scales {scales};"
            f" signal {output['signal_std']:.3g}, noise {output['noise_std']:.3g} {describe(name, 'residuals').unit}"
        )
    if isinstance(model, VehicleModel):
        summary |= {"thrust": str(model.thrust), "best": model.best}
        summary["models"] = {kind: one.rows() for kind, one in model.models.items()}
        lines += _vehicle_lines(model, load_report(path))
    else:
        lines.append(f"drag        {model.linear_drag}")
    summary["feature_range"] = dict(model.feature_range)
    lines += range_lines(model.feature_range)
    settings = {k: v for k, v in summary["settings"].items() if k != "features"}
    if settings:
        lines.append("settings    " + ", ".join(f"{k} {v}" for k, v in settings.items()))
    lines += _provenance_lines(summary)
    return summary | {"lines": lines}


def _vehicle_lines(model: Any, report: Mapping[str, Any]) -> list[str]:
    """Coefficients with 95 % intervals, and the ladder of models where the report has it."""
    from quadexp.report.identify_lines import model_lines, selection_lines

    lines = model_lines(model)
    if report.get("selection"):
        lines += selection_lines(report["selection"], report.get("best_row", model.best))
    return lines + [f"note        {note}" for note in model.notes]


def _config_lines(config: Mapping[str, Any] | None) -> list[str]:
    """The configuration, a line per group, numbers only where they are few."""
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
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_short, value)) + "]"
    return str(value)


def _unit_lines(columns: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Columns that share unit and frame in one line."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name, column in columns.items():
        groups.setdefault((column["unit"] or "-", column["frame"]), []).append(name)
    return [
        f"columns     {' '.join(names)}  [{unit}{', ' + frame if frame else ''}]"
        for (unit, frame), names in groups.items()
    ]


def _provenance_lines(record: Mapping[str, Any]) -> list[str]:
    provenance, versions = record.get("provenance", {}), record.get("versions", {})
    lines = []
    if versions:
        lines.append("versions    " + ", ".join(f"{name} {version}" for name, version in versions.items()))
    if record.get("sources"):
        lines.append(f"sources     {record['sources']} (hash of what decides a flight)")
    if provenance:
        git = provenance.get("git") or {}
        revision = f"commit {git['commit'][:10]}{' with changes' if git.get('dirty') else ''}, " if git else ""
        lines.append(f"made        {provenance.get('created')}, {revision}{provenance.get('cpu')}")
    return lines


def _size(count: int) -> str:
    return f"{count / 1e6:.2f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"
