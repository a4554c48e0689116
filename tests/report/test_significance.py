"""One verdict in a table: whatever a third contestant does, in every line and sentence, in text, LaTeX and page."""

import math
import re

import numpy as np
import pytest

from quadexp.log.store import write_table
from quadexp.plugins.page.compare import compare
from quadexp.plugins.page.report.answer import answer
from quadexp.plugins.page.report.source import read_comparison
from quadexp.report.inference import holm, sign_flips
from quadexp.report.metrics import to_columns
from quadexp.report.statistics import compute_statistics, overall
from quadexp.report.tables import error_table
from tests.report.results import verdicts
from tests.report.test_tables import row

FACTORS = {"nominal_mpc": 1.0, "linear_drag_mpc": 0.5, "gp_mpc": 0.1}


def flights(factors=FACTORS, *, seeds=10, speeds=(4.0, 8.0, 12.0), spread=0.02, **more):
    rng = np.random.default_rng(seeds)
    return [
        row(name, speed=speed, seed=seed, error=float(0.01 * speed * factor * np.exp(spread * rng.normal())), **more)
        for name, factor in factors.items()
        for speed in speeds
        for seed in range(seeds)
    ]


def without(rows, name, gone, outcome="lost"):
    """The same rows, those of a contestant that are `gone` (speed, seed) without a result."""
    failed = {"outcome": outcome, "mean_error": math.nan, "rmse": math.nan}
    return [r | failed if r["controller"] == name and gone(r["speed"], r["seed"]) else r for r in rows]


def results(folder, rows):
    times = {"solve_time_median": 3e-5, "solve_time_p99": 6e-5, "backend": "compiled"}
    rows = [times | made | {"key": f"{i:020x}"} for i, made in enumerate(rows)]
    record = {"metric": "mean_error", "grids": [], "conditions": [], "versions": {}, "provenance": {}}
    write_table(folder / "results.parquet", to_columns(rows), record, "results")
    return folder


BAD = {
    "thirteen of thirty lost": (lambda speed, seed: speed == 12.0 or (speed == 8.0 and seed < 3), "lost"),
    "none completed": (lambda speed, seed: True, "solver_failed"),
    "a single one completed": (lambda speed, seed: (speed, seed) != (4.0, 0), "lost"),
    "every seed loses one": (lambda speed, seed: seed % 3 == int(speed) // 4 - 1, "failed"),
    "nobody could": (lambda speed, seed: speed == 8.0, "infeasible"),
    "contradicting settings": (lambda speed, seed: speed == 8.0, "invalid"),
    "without a number": (lambda speed, seed: seed < 7, "ok"),
}


@pytest.mark.parametrize("bad", BAD)
def test_a_third_one_takes_nothing_from_a_pair(bad, tmp_path):
    alone, gone = flights(), BAD[bad]
    rows = without([*alone, *flights({"pid": 3.0})], "pid", *gone)
    for made in (alone, rows):
        pooled = {s.controller: s for s in overall(made)}
        assert pooled["gp_mpc"].pairs == 30 and pooled["gp_mpc"].units == 10 and pooled["gp_mpc"].left_out == ""
        assert pooled["gp_mpc"].significant and pooled["linear_drag_mpc"].significant
        (verdict,) = verdicts(made)
        assert verdict.best and verdict.least == "gp_mpc"
    alike = [s.reduction for made in (alone, rows) for s in overall(made) if s.controller == "gp_mpc"]
    assert alike[0] == alike[1]
    lines = {(s.controller, s.speed): s for s in compute_statistics(rows, metrics=("mean_error",))}
    assert all(lines["gp_mpc", speed].significant and lines["gp_mpc", speed].pairs == 10 for speed in (4.0, 8.0, 12.0))
    assert not any(math.isnan(s.common_mean) for s in lines.values() if s.controller != "pid")
    better = [r | {"mean_error": 0.5 * r["mean_error"]} for r in rows]
    report = compare(results(tmp_path / "a", rows), results(tmp_path / "b", better))
    pairs = {record["label"]: record["pairs"] for record in report["metrics"]}
    assert pairs["gp_mpc"] == pairs["nominal_mpc"] == 30


def test_who_is_ahead_on_the_few_flights_it_completed_leaves_no_best():
    rows = without([*flights(), *flights({"pid": 0.01})], "pid", lambda speed, seed: seed > 1)
    (verdict,) = verdicts(rows)
    assert not verdict.best and verdict.flew_less and verdict.least == "pid"


def test_unequal_seeds_and_conditions_of_some_only():
    """gp_mpc has three seeds, linear_drag_mpc two of three speeds: what they have is compared, and the rest named."""
    rows = [r for r in flights() if r["controller"] != "gp_mpc" or r["seed"] < 3]
    rows = [r for r in rows if r["controller"] != "linear_drag_mpc" or r["speed"] < 12]
    gp, linear = ({s.controller: s for s in overall(rows)}[name] for name in ("gp_mpc", "linear_drag_mpc"))
    assert (linear.pairs, linear.conditions, linear.units) == (20, 2, 10) and linear.significant
    assert "10 not asked for" in linear.left_out
    assert gp.pairs == 9 and not gp.testable and "3 seeds, too few for a test" in gp.text()
    (verdict,) = verdicts(rows)
    assert not verdict.best


@pytest.mark.parametrize("seeds", [2, 3, 5])
def test_too_few_seeds_name_nobody_anywhere_and_say_once_what_would(seeds, tmp_path):
    """Log ratios of two modes, or a hundredfold difference: with five seeds or fewer nothing is claimed."""
    rows = flights(seeds=seeds)
    table = error_table(rows)
    said = table.markdown()
    assert "**" not in said and r"\textbf" not in table.latex() and "*" not in "".join(map("".join, table.rows))
    assert "best of" not in said and "significantly" not in said
    assert said.count("cannot show p < 0.05") == 1 and "at least 7 are needed, 8 in a single line" in said
    page = answer(read_comparison(results(tmp_path, rows)))
    assert "best" not in page.gain and "not at all yet" in page.sure


def test_as_many_seeds_as_it_asks_for_are_enough():
    rows = flights(seeds=8)
    table = error_table(rows)
    assert table.markdown().count("**") == 2 * 3 and "the best of 3" in table.markdown()
    seven = error_table(flights(seeds=7))
    assert "**" not in seven.markdown() and "the best of 3" in seven.markdown()
    assert "7 seeds: nothing is bold or *, which takes 8 in a single line" in seven.notes


def test_bold_star_and_sentences_agree():
    """No contestant is bold, or the best, that its own p does not tell from the baseline, and from every other."""
    rng, named = np.random.default_rng(0), 0
    for _ in range(40):
        shift = dict(zip(FACTORS, np.exp(rng.normal(0, 0.02, 3)), strict=True))
        rows = flights(shift, seeds=int(rng.integers(6, 14)), speeds=(4.0, 8.0))
        lines = compute_statistics(rows, metrics=("mean_error",))
        (verdict,), pooled = verdicts(rows), {s.controller: s for s in overall(rows)}
        for best in (s for s in lines if s.best):
            compared = [s for s in lines if s.speed == best.speed and s.baseline]
            same = best.significant if best.baseline else all(s.significant for s in compared)
            assert same and best.best_p < 0.05
            named += 1
        if verdict.best and verdict.least != "nominal_mpc":
            assert pooled[verdict.least].significant
            named += 1
    assert named > 10


def test_joint_p_and_holm_by_hand():
    # One line: 2 of 2^3 patterns. Two lines of one pair with opposite signs at one seed: 2 x 2 / 8 in view of both.
    assert sign_flips([[1.0, 2.0, 3.0]])[0][0] == 0.25
    alone, joint, _ = sign_flips([[1.0, 2.0, 4.0], [1.0, -2.0, 4.0]])
    assert alone.tolist() == [0.25, 0.75] and joint.tolist() == [0.5, 1.0]
    # A pair leaves the count once all of its lines are rejected: 2 x 0.02 for the first, 1 x 0.03 for the second one.
    assert holm(np.array([[0.01, 0.02], [0.03, 0.5]])).tolist() == [[0.02, 0.04], [0.04, 0.5]]


class TestHeadline:
    """A gain that differs between what was swept is not hidden in one number, nor are flights that are not in it."""

    @staticmethod
    def said(folder, *parts):
        comparison = read_comparison(results(folder, [one for part in parts for one in part]))
        found = answer(comparison)
        return re.sub("[\u202f\u00a0]", " ", f"{found.flown} {found.gain} {found.sure} {found.note}")

    @pytest.mark.parametrize("name", ["plant", "vehicle"])
    def test_every_world_has_its_sentence(self, name, tmp_path):
        calm = flights(seeds=8, **{name: "calm"})
        windy = flights({"nominal_mpc": 4.0, "linear_drag_mpc": 2.5, "gp_mpc": 3.0}, seeds=8, **{name: "windy"})
        said = self.said(tmp_path, calm, windy)
        assert "All 144 flights were completed." in said
        gains = re.findall(r"(calm|windy)[^;:]*, gp_mpc: (\d+)\.\d %", said)
        assert dict(gains) == {"calm": "89", "windy": "24"}
        assert re.search(r"[Ll]east over the 24 flights that all completed in [^:]*windy[^:]*: linear_drag_mpc", said)
        assert "72 flights in" in said

    @pytest.mark.parametrize("setting", ["wind.velocity", "sensor.noise", "plant.payload", "vehicle.mass"])
    def test_a_swept_setting_that_turns_it_round(self, setting, tmp_path):
        turned = {"nominal_mpc": 1.0, "linear_drag_mpc": 0.5, "gp_mpc": 1.2}
        rows = flights(seeds=8, variant=f"{setting}=0"), flights(turned, seeds=8, variant=f"{setting}=8")
        said = self.said(tmp_path, *rows)
        assert f"% more in circle 4 m/s {setting}=8" in said or re.search(
            rf"% more in circle \d+ m/s {setting}=8", said
        )
        assert "less by others in 3 of 6 conditions (linear_drag_mpc: 0.4" in said
        table = error_table([one for part in rows for one in part]).markdown()
        assert re.search(rf"gp\\?_mpc: .* more in circle \d+ m/s {setting}=8 to", table.replace("\\", ""))

    def test_a_world_without_a_pair_is_counted(self, tmp_path):
        other = flights({"pid": 1.0, "geometric": 2.0}, seeds=8, plant="other")
        said = self.said(tmp_path, flights(seeds=8, plant="calm"), other)
        assert "Not in it: 48 flights in other torrente, where they have no pair." in said
