"""The Python API: the same numbers as the commands, errors by name, nothing written unless asked for."""

import ast
import copy
import gc
import os
import pickle
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import quadexp as qx
from quadexp.api import Scratch
from quadexp.log.store import read_flight, read_table
from tests.cli.command import run
from tests.log.flights import straight_flight

ROOT = Path(__file__).resolve().parents[2]
INTERPRETED = ("controller.backend=interpreted", "plant.backend=interpreted")
QUICK = ("trajectory=hover", "trajectory.duration=0.5", *INTERPRETED)
MOVING = ("controller=nominal_mpc", "trajectory.acceleration=4", "trajectory.duration=2")
TIMES = {"solve_time", "solve_time_median", "solve_time_p99", "solve_time_max"}


def same(one: pd.DataFrame, columns: dict[str, np.ndarray]) -> None:
    """Every bit of every column but wall times."""
    assert list(one.columns) == list(columns)
    for name, values in columns.items():
        found = one[name].to_numpy(object if values.dtype == object else None)
        assert found.dtype == values.dtype, name
        if name not in TIMES:
            assert found.tobytes() == values.tobytes() if values.dtype != object else (found == values).all(), name


class TestImport:
    def test_it_is_light(self):
        heavy = "('torch', 'casadi', 'pandas', 'hydra', 'numpy', 'pyarrow', 'matplotlib', 'scipy', 'rich', 'typer')"
        code = f"import sys, quadexp as qx; dir(qx); print([name for name in {heavy} if name in sys.modules])"
        assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT).stdout == "[]\n"

    def test_every_name_is_there_with_a_docstring(self):
        for name in qx.__all__:
            assert getattr(qx, name) is not None and name in dir(qx)
            assert name.startswith("__") or getattr(qx, name).__doc__, name
        with pytest.raises(AttributeError, match="no attribute 'simulat'"):
            _ = qx.simulat

    def test_type_checkers_see_the_same_names(self):
        stub = ast.parse((ROOT / "quadexp" / "__init__.pyi").read_text())
        found = {(node.names[0].asname, node.module) for node in stub.body if isinstance(node, ast.ImportFrom)}
        assert found == {(name, place.partition(":")[0]) for name, place in qx._places().items()}


class TestSimulate:
    SETTINGS = ("controller=perfect_mpc", "trajectory=circle", "trajectory.speed=3", "trajectory.radius=1")

    def test_it_is_the_command_to_the_last_bit(self, here):
        code, _, errors = run("simulate", *self.SETTINGS, *INTERPRETED, "--out", "a.parquet")
        assert code == 0, errors
        flight = qx.simulate(
            *INTERPRETED, {"controller": "perfect_mpc", "trajectory": "circle"}, speed=3.0, radius=1, seed=0
        )
        same(flight, read_table(here / "a.parquet", "flight")[0])
        same(qx.load("a.parquet"), read_table(here / "a.parquet", "flight")[0])
        written = read_flight(here / "a.parquet").metadata
        times = dict.fromkeys(TIMES, 0)
        assert written["row"] | times == flight.metrics | times
        assert written["config"] == flight.record["config"]
        assert os.listdir(here) == ["a.parquet"]

    def test_what_is_written_is_what_is_returned(self, here):
        flight = qx.simulate(*QUICK, out="b.parquet")
        same(qx.load(Path("b.parquet")), read_table("b.parquet", "flight")[0])
        np.testing.assert_array_equal(flight["solve_time"], read_flight("b.parquet")["solve_time"])
        with pytest.raises(qx.UsageError, match=r"b\.parquet: exists already"):
            qx.simulate(*QUICK, out="b.parquet")
        qx.simulate(*QUICK, out="b.parquet", force=True)
        copied = qx.load("b.parquet").save("c.parquet")
        same(qx.load("b.parquet"), read_table(copied, "flight")[0])

    def test_units_go_with_slices_and_into_other_files(self, here):
        flight = qx.simulate(*QUICK)
        part = flight[flight["t"] > 0.2]
        assert isinstance(part, qx.Flight) and part.attrs["units"]["v_x"] == "m/s" and part.outcome == "ok"
        assert part.attrs["frames"]["w_x"] == "body" and part.attrs["frames"]["v_x"] == "world"
        flight.to_parquet("plain.parquet")
        assert pd.read_parquet("plain.parquet").attrs["units"] == flight.attrs["units"]

    @pytest.mark.parametrize(
        ("settings", "keywords", "message"),
        [
            (["trajectory.sped=8"], {}, r"trajectory\.sped: no such key; did you mean trajectory\.speed\?"),
            ([], {"sped": 8}, r"trajectory\.sped: no such key"),
            ([{"controller": "no_mpc"}], {}, "controller=no_mpc: no such controller; did you mean"),
            ([], {"speed": [4, 8]}, r"trajectory\.speed"),
            ([], {"speed": object()}, r"trajectory\.speed: a object is no value"),
            ([3], {}, "3: settings are text KEY=VALUE"),
            ([{3: 4}], {}, "3: keys are text"),
            (["controller=gp_mpc"], {"model": "no/where, [at] 'all'"}, r"model=no/where, \[at\] 'all': no checkpoint"),
            (["trajectory=circle"], {"speed": 59}, "cannot be flown"),
        ],
    )
    def test_errors_are_named_and_one_line(self, settings, keywords, message):
        with pytest.raises(qx.UsageError, match=message) as caught:
            qx.simulate(*settings, **keywords)
        assert "\n" not in str(caught.value) and isinstance(caught.value, qx.QuadexpError)

    def test_a_folder_of_ones_own(self):
        flight = qx.simulate("trajectory=helix", *INTERPRETED, conf=ROOT / "examples", turns=0.5)
        assert flight.record["config"]["trajectory"]["turns"] == 0.5

    def test_values_of_python_are_values_of_the_configuration(self):
        flight = qx.simulate(
            *QUICK,
            controller={"position_weight": np.array([1.0, 2.0, 3.0]), "feedforward": False},
            seed=np.int64(7),
            position=(0, 0, 2.5),
        )
        config = flight.record["config"]
        assert config["controller"]["position_weight"] == [1.0, 2.0, 3.0] and config["seed"] == 7
        assert config["controller"]["feedforward"] is False and flight["p_z"].iloc[0] == 2.5


class TestLearning:
    def test_data_set_and_fit_are_the_commands_to_the_last_bit(self, here):
        short = ("collect.duration=15", "collect.flight_duration=4", *INTERPRETED)
        gp = ("gp.inducing=5", "gp.max_iterations=3", "gp.max_rows=100")
        assert run("collect", *short, "--out", "d.parquet")[0] == 0
        assert run("fit-gp", "d.parquet", *gp, "--out", "gp", "--no-figures")[0] == 0
        assert run("fit-drag", "d.parquet", "--out", "drag")[0] == 0
        data = qx.collect(*INTERPRETED, duration=15, flight_duration=4)
        same(data, read_table("d.parquet", "residuals")[0])
        model, drag = qx.fit_gp(data, inducing=5, max_iterations=3, max_rows=100), qx.fit_drag(data)
        for made, folder in ((model, "gp"), (drag, "drag")):
            assert (made.path / "model.json").read_bytes() == Path(folder, "model.json").read_bytes()
            assert made.report["rows"] == qx.load(folder).report["rows"]
        assert set(os.listdir(here)) == {"d.parquet", "gp", "drag"}

        predicted = model.predict(data)
        assert list(predicted.columns) == ["a_x", "a_x_std", "a_y", "a_y_std", "a_z", "a_z_std"]
        error = (predicted["a_x"] - data["a_x"]).std()
        assert error < 0.8 * (drag.predict(data)["a_x"] - data["a_x"]).std() < 0.8 * data["a_x"].std()
        assert model.plot(data).axes

        flight = qx.simulate("controller=gp_mpc", *QUICK, model=model)
        assert (
            flight.record["model_sha256"] == qx.simulate("controller=gp_mpc", *QUICK, model="gp").record["model_sha256"]
        )
        folder = model.path
        del model, made
        gc.collect()
        assert not folder.exists()

    def test_a_part_of_the_data_can_be_fitted(self):
        data = qx.collect(*INTERPRETED, duration=8, flight_duration=2)
        assert qx.fit_drag(data[data["flight"] < 3], holdout=0).model.dataset["rows"] == (data["flight"] < 3).sum()
        with pytest.raises(qx.UsageError, match="a table without its record"):
            qx.fit_drag(pd.DataFrame(data))
        with pytest.raises(qx.DataError, match="flown by vehicle torrente"):
            qx.fit_drag(data, "vehicle=crazyflie")

    def test_one_flight_stands_for_a_list_of_it(self, here):
        flown = qx.simulate("trajectory=random", "trajectory.speed=5", *INTERPRETED, out="a.parquet")
        among = [qx.collect(flights=flights) for flights in (flown, [flown], "a.parquet", Path("a.parquet"))]
        among += [qx.collect(flights=flights) for flights in (("a.parquet",), iter([flown]))]
        among = [rows.drop(columns="flight_name") for rows in among]  # the file that it was read from
        assert len(among[0]) > 100 and all(rows.equals(among[0]) for rows in among)


class TestSweep:
    def test_it_is_the_command_to_the_last_bit(self, here):
        swept = ("controller=nominal_mpc,perfect_mpc", "trajectory.height=1,2", "seed=0,1")
        circle = ("trajectory=circle", "trajectory.speed=3", "trajectory.radius=1")
        code, _, errors = run("evaluate", "--sweep", *swept, *circle, *INTERPRETED, "--out", "r", "--no-figures")
        assert code == 0, errors
        results = qx.sweep(
            {"controller": ["nominal_mpc", "perfect_mpc"], "trajectory.height": [1, 2]},
            *circle,
            *INTERPRETED,
            seed=range(2),
            speed=3,
        )
        columns = read_table("r/results.parquet", "results")[0]
        order = [f"{row.controller} {row.variant} {row.seed}" for row in results.itertuples()]
        keys = zip(columns["controller"], columns["variant"], columns["seed"], strict=True)
        assert order == [" ".join(map(str, key)) for key in keys]
        same(results, columns)
        same(qx.load("r"), columns)
        same(qx.load("r/results.parquet"), columns)
        assert str(results.table()).strip() in Path("r/table.md").read_text().strip()
        assert os.listdir(here) == ["r"]
        assert results.table("rmse").title == "RMSE (mm)"

        chosen = results[(results["controller"] == "perfect_mpc") & (results["seed"] == 1)]
        flight = chosen.flight(-1)
        assert flight.metrics["key"] == chosen["key"].iloc[-1] and flight.record["config"]["trajectory"]["height"] == 2
        cell = Path("r/cells", flight.metrics["key"][:2], f"{flight.metrics['key']}.parquet")
        same(flight, read_table(cell, "flight")[0])
        with pytest.raises(qx.UsageError, match="row 2: the table has 2 rows"):
            chosen.flight(2)

        means = results.statistics()
        assert set(means["controller"]) == {"nominal_mpc", "perfect_mpc"} and (means["n"] == 2).all()
        assert results.plot().axes and len(pickle.loads(pickle.dumps(results))) == 8
        assert copy.deepcopy(results).flight(0).outcome == "ok"
        with pytest.raises(qx.UsageError, match="metric 'speed': there are rmse, mean_error, max_error"):
            results.table("speed")

    def test_what_cannot_be_flown_is_a_row(self):
        results = qx.sweep("trajectory=circle", *INTERPRETED, speed=[2, 59], radius=1)
        assert list(results["outcome"]) == ["ok", "infeasible"] and "cannot be flown" in results["cause"].iloc[1]
        with pytest.raises(qx.UsageError, match="row 1 was not flown: circle cannot be flown"):
            results.flight(1)
        with pytest.raises(qx.UsageError, match="no column 'p_x' to draw"):
            results.flight(0)[["t", "v_x"]].plot()

    def test_parts_of_results_are_tables_too(self, here):
        """Columns, no rows, two sweeps after each other, an added column: shown, or refused in one line."""
        results = qx.sweep(*QUICK, seed=[0, 1])
        for part in (results[["controller", "mean_error"]], results[results["seed"] > 5]):
            assert "<pre>results: " in part._repr_html_()
            with pytest.raises(qx.UsageError, match="need all columns"):
                part.table()
        both = pd.concat([results, qx.sweep(*QUICK, seed=[2])])
        assert "3 of 3" in both._repr_html_() and both.table("rmse").rows[0][0] == "flown"
        results["late"] = results["seed"] > 0
        results.save("results.parquet")
        assert qx.load("results.parquet")["late"].tolist() == [0, 1]

    @pytest.mark.parametrize("values", [[], range(0)])
    def test_nothing_to_fly(self, values):
        with pytest.raises(qx.UsageError, match="seed: an empty list"):
            qx.sweep(*QUICK, seed=values)

    def test_a_script_needs_no_guard(self, tmp_path):
        """Workers do not run the script that started them once more."""
        script = tmp_path / "script.py"
        settings = ", ".join(map(repr, QUICK))
        script.write_text(
            f"print('begun')\nimport quadexp as qx\nr = qx.sweep({settings}, seed=[0, 1])\n"
            "print(list(r['outcome']), __file__)\n"
        )
        done = subprocess.run(
            [sys.executable, str(script)], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
        )
        assert done.stdout == f"begun\n['ok', 'ok'] {script}\n", done.stderr

    def test_it_may_be_started_in_a_process_of_a_pool(self, tmp_path):
        """Whose processes may have no children; also where they are forked from one that has flown a sweep."""
        script = tmp_path / "pool.py"
        script.write_text(
            "import multiprocessing\nimport quadexp as qx\n"
            "def flown(seed):\n"
            f"    return list(qx.sweep(*{QUICK!r}, seed=[seed, seed + 1]).outcome)\n"
            "if __name__ == '__main__':\n"
            "    first = flown(0)\n"
            "    with multiprocessing.get_context('fork').Pool(1) as pool:\n"
            "        print(first + pool.map(flown, [2])[0])\n"
        )
        known = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=known)
        assert done.stdout == f"{['ok'] * 4}\n", done.stderr

    def test_a_dictionary_in_a_list_is_a_value(self):
        change = {"plant.schedule": [{"t": 0.1, "payload": 0.1}]}
        flown = qx.simulate(*QUICK, change, vehicle="lei_li", plant="blade_element")
        assert flown.record["config"]["plant"]["schedule"] == [{"t": 0.1, "payload": 0.1}]


def test_folders_that_nobody_keeps_go_without_a_word(monkeypatch):
    """And not with a copy of what refers to them in a process that was forked meanwhile."""
    said = []
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        scratch = Scratch()
        folder = Path(os.fspath(scratch))
        if not (child := os.fork()):
            del scratch
            gc.collect()
            os._exit(0)
        os.waitpid(child, 0)
        assert folder.is_dir()
        del scratch
        gc.collect()
    assert not folder.exists() and not said


class TestLoad:
    def test_a_flight_of_a_log_has_no_row(self, here):
        flight = straight_flight()
        loaded = qx.Flight.of(flight.columns, {"recorded": True})
        assert loaded.metrics == {} and loaded.summary() == [f"flight: {len(loaded)} rows"]
        assert loaded._repr_html_().startswith("<pre>flight: ") and loaded.plot().axes


class TestLoop:
    CIRCLE = ("trajectory=circle", "trajectory.speed=3", "trajectory.radius=1")
    LEI_LI = ("vehicle=lei_li", "plant=blade_element")

    @pytest.mark.parametrize(
        "settings",
        [
            ("controller=perfect_mpc", "sensor=perfect", *CIRCLE),
            ("controller=rls_mpc", *LEI_LI, "sensor=perfect", *CIRCLE),
            ("controller=rls_feedback", *LEI_LI, "sensor=perfect", "trajectory=hover", "trajectory.duration=1"),
        ],
        ids=lambda settings: settings[0],
    )
    def test_it_flies_what_simulate_flies(self, settings):
        """Without noise, so that both loops meet the same plant; with what identifies in flight, too."""
        settings = (*settings, *INTERPRETED)
        quiet = ["motor_noise_density", "force_noise_density", "torque_noise_density"]
        plant = {} if "plant=blade_element" in settings else {"plant": dict.fromkeys(quiet, 0)}
        flight = qx.simulate(*settings, **plant)
        loop = qx.controller(*settings, **plant)
        state, reading, flown = loop.start, None, []
        loop.plant.reset()
        for t in loop.times:
            speed = getattr(loop.plant, "rotor_speed", None) if reading is not None else None
            thrusts = loop.step(qx.Measurement(t, state, reading, speed))
            assert not loop.failed
            flown.append([*state, *thrusts])
            state, reading = loop.plant.advance(state, thrusts, loop.period, np.random.default_rng(0))
        log = flight.arrays()
        np.testing.assert_array_equal(np.array(flown), np.hstack([log.state, log.input]))

    def test_two_loops_and_a_flight_do_not_disturb_each_other(self):
        settings = ("controller=nominal_mpc", "trajectory=circle", *INTERPRETED)
        one, other = (qx.controller(*settings) for _ in range(2))
        far = one.start + np.eye(13)[0]
        alone = [one.step(far, t) for t in one.times[:5]]
        one.reset(far)
        again = []
        for t in one.times[:5]:
            again.append(one.step(far, t))
            other.step(other.start, t)
        np.testing.assert_array_equal(alone, again)

    def test_flights_in_threads_are_those_of_one_after_the_other(self):
        """Of equal settings and of others: what is kept between flights belongs to one thread."""
        given = [("trajectory=ellipse", f"trajectory.speed={v}", *MOVING) for v in (3, 3, 4, 5)]
        alone = [qx.simulate(*settings) for settings in given]
        with ThreadPoolExecutor(4) as pool:
            together = [*pool.map(lambda settings: qx.simulate(*settings), 2 * given)]
        for one, other in zip(together, 2 * alone, strict=True):
            same(one, other.arrays().columns)

    def test_a_loop_is_of_one_thread_at_a_time(self):
        """Three threads in one loop overwrote its arrays and ended the process."""
        loop = qx.controller("controller=nominal_mpc", "trajectory=hover")
        for t in loop.times[:2]:  # from the second step on in C
            loop.step(loop.start, t)

        def stepped(k: int) -> bool:
            try:
                return bool(np.isfinite(loop.step(loop.start, k * loop.period)).all())
            except qx.UsageError as error:
                assert "another thread is in this loop" in str(error)
                return True

        with ThreadPoolExecutor(3) as pool:
            assert all(pool.map(stepped, range(300)))
            with loop.busy, pytest.raises(qx.UsageError, match=r"step: another thread is in this loop"):
                pool.submit(loop.step, loop.start, 0.0).result()
        assert stepped(300) and not loop.failed

    def test_a_window_of_ones_own_planner(self):
        """Hover at a point 20 cm away: the vehicle gets there."""
        loop = qx.controller("controller=nominal_mpc", "plant=ideal", "trajectory=hover", *INTERPRETED)
        goal, n = loop.start, len(loop.controller.node_times)
        goal[:3] += [0.2, -0.1, 0.1]
        position = np.zeros((5, 3))
        position[0] = goal[:3]
        thrusts = np.full((n - 1, loop.vehicle.n_rotors), loop.vehicle.hover_thrust)
        window = qx.Window(np.tile(goal, (n, 1)), thrusts, position, np.zeros(3))
        state = loop.start
        for k in range(150):
            u = loop.step(state, k * loop.period, window)
            state, _ = loop.plant.advance(state, u, loop.period, np.random.default_rng(0))
        assert np.linalg.norm(state[:3] - goal[:3]) < 2e-3 and loop.rates.shape == (3,)

    def test_rates_are_those_of_the_mpc_inside_its_remedies(self):
        """Of an MPC with anything around it they were None."""
        loop = qx.controller("controller=nominal_mpc", "delay=auto", "plant=ideal", "trajectory=hover", *INTERPRETED)
        loop.step(loop.start, 0.0)
        assert loop.rates.shape == (3,) and np.isfinite(loop.rates).all()

    def test_what_is_wrong_is_said(self):
        loop = qx.controller("controller=nominal_mpc", "trajectory=hover", *INTERPRETED)
        for call, message in (
            (lambda: loop.step(np.zeros(12), 0.0), r"state: \(12,\) numbers are given, \(13,\) are needed"),
            (lambda: loop.step(loop.start), "t is needed"),
            (lambda: loop.step(loop.start, float("nan")), "must be a finite time"),
            (lambda: loop.follow(3), "a int is no trajectory"),
        ):
            with pytest.raises(qx.UsageError, match=message):
                call()
        with pytest.raises(qx.QuadexpError):
            loop.step(np.full(13, np.nan), 0.0)


class TestHtml:
    def test_names_of_others_are_text(self):
        results = qx.sweep(*QUICK)
        results["controller"] = "<script>alert(1)</script>\x1b[2J"
        shown = results._repr_html_()
        assert "<script>" not in shown and "\x1b" not in shown and "&lt;script&gt;" in shown


def test_a_keyword_may_be_a_dotted_key():
    """As **{"controller.nodes": 7}, and as a dictionary."""
    flight = qx.simulate(*QUICK, **{"controller.nodes": 7})
    assert flight.record["config"]["controller"]["nodes"] == 7


def test_a_sweep_that_no_memory_holds_is_refused():
    with pytest.raises(qx.UsageError, match="seed: 1000000000 values; a sweep has at most 1000000 cells"):
        qx.sweep(*QUICK, seed=range(10**9))
