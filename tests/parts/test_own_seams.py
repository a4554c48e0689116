"""What it costs to add a thing from a folder of one's own, outside this repository: one file and one option each.

A learned model and a metric stand in a --conf folder; a command, a reader of logs, a section of the report page and a
paper in a module of a package, with one line of BRINGS each. All of them are really used.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from quadexp.experiment.identity import flight_identity
from quadexp.parts.compose import compose
from tests.cli.command import run
from tests.deleted import needs

ROOT = Path(__file__).resolve().parents[2]
QUICK = ["controller.backend=interpreted", "plant.backend=interpreted"]

MODEL = """
from dataclasses import dataclass
import numpy as np
from quadexp.models.coefficients import Equation
from quadexp.parts.settings import key

@dataclass(frozen=True, kw_only=True)
class Lateral(Equation):
    units = {"d": "1/s"}
    shrink: float = key(0.0, "pulls the coefficient towards zero", "[0, 1]")

    def acceleration(self, z, theta):
        return -theta[0] * z[:3]

    def estimate(self, rows):
        velocity, measured = rows.matrix(["v_x", "v_y", "v_z"]), rows.matrix(["a_x", "a_y", "a_z"])
        return [-(1 - self.shrink) * np.sum(velocity * measured) / np.sum(velocity**2)]
"""
METRIC = """
import numpy as np
from quadexp.report.metrics import FlightMetric

class HeightError(FlightMetric):
    title, unit, factor = "height error", "mm", 1e3

    def of(self, flight):
        return np.abs(flight["p_z"] - flight["ref_p_z"]).max()
"""


def option(folder, group, name, module, text, class_name):
    """One file and one option."""
    (folder / group).mkdir(parents=True, exist_ok=True)
    (folder / f"{module}.py").write_text(text)
    (folder / group / f"{name}.yaml").write_text(f"_target_: {module}.{class_name}\n")
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "data.parquet"
    code, _, error = run("collect", "collect.duration=40", "collect.flight_duration=6", *QUICK, "--out", path)
    assert code == 0, error
    return path


@pytest.fixture(scope="module")
def lateral(data, tmp_path_factory):
    """The folder of a model, and its checkpoint, fitted by the command."""
    folder = option(tmp_path_factory.mktemp("lab"), "model", "lateral", "lateral", MODEL, "Lateral")
    fitted = run("fit", "lateral", data, "model.holdout=0.5", "--conf", folder, "--out", folder / "fitted", "--json")
    assert fitted[0] == 0, fitted[2]
    return folder, json.loads(fitted[1])


class TestLearnedModel:
    def test_it_is_fitted_reported_and_judged(self, lateral, data):
        folder, report = lateral
        assert report["kind"] == "lateral" and 0.3 < report["coefficients"]["d"] < 1.5
        assert {row["predictor"] for row in report["rows"]} == {"lateral", "linear_drag", "zero"}
        assert report["verdict"]["flights"] >= 3 and set(report["verdict"]["outputs"]) == {"a_x", "a_y", "a_z"}
        code, out, error = run("show", folder / "fitted")
        assert code == 0 and "equation    d = " in out, error
        changed = run("fit", "lateral", data, "model.shrink=0.5", "--conf", folder, "--out", folder / "half", "--json")
        assert json.loads(changed[1])["coefficients"]["d"] == pytest.approx(report["coefficients"]["d"] / 2)

    def test_it_flies_in_any_controller_alone_and_in_sums_and_in_processes(self, lateral, data, tmp_path):
        folder, _ = lateral
        own = ["--conf", folder, "trajectory.speed=6", *QUICK]
        flown = {}
        for controller in ("nominal_mpc", "geometric"):
            words = [f"controller={controller}", "controller.residual=lateral", f"model={folder / 'fitted'}"]
            words = [word for word in (*words, *own) if controller == "nominal_mpc" or word != QUICK[0]]
            code, out, error = run("simulate", *words, "--out", tmp_path / f"{controller}.parquet", "--json")
            assert code == 0, error
            flown[controller] = json.loads(out)
            assert flown[controller]["residual"]["name"] == "lateral"
        code, out, _ = run("simulate", "controller=nominal_mpc", *own, "--out", tmp_path / "none.parquet", "--json")
        assert flown["nominal_mpc"]["mean_error"] < 0.6 * json.loads(out)["mean_error"]
        fitted = ("fit", "linear_drag", data, "--after", folder / "fitted", "--conf", folder)
        fitted = (*fitted, "--out", tmp_path / "rest")
        assert run(*fitted)[0] == 0
        sums = [
            "controller=sum_mpc", "controller.residual=[lateral,linear_drag]",
            f"controller.models=[{folder / 'fitted'},{tmp_path / 'rest'}]",
        ]  # fmt: skip
        code, out, error = run("evaluate", "--sweep", *sums, *own, "seed=0,1", "--no-figures", "--out", tmp_path / "r")
        assert code == 0 and "2 of 2" in out, error  # flown in other processes

    def test_an_edit_of_it_flies_its_flights_again_and_no_others(self, lateral, tmp_path):
        folder, _ = lateral
        words = ["controller=nominal_mpc", "controller.residual=none,lateral", f"model={folder / 'fitted'}", *QUICK]
        words = ["evaluate", "--sweep", "--conf", folder, *words, "--no-figures", "--out", tmp_path / "r", "--json"]
        assert run(*words)[0] == 0
        of_plant = ["plant=from_model", f"plant.model={folder / 'fitted'}"]
        as_truth = flight_identity(compose(of_plant, folder)).digest
        file = folder / "lateral.py"
        file.write_text(file.read_text().replace("-theta[0] * z", "-1.0 * theta[0] * z"))
        code, out, error = run(*words)
        assert code == 0 and json.loads(out)["flown"] == 1, error
        assert flight_identity(compose(of_plant, folder)).digest != as_truth

    def test_an_edit_after_its_fit_is_said_wherever_it_is_used(self, lateral, tmp_path):
        """Of its own text and of a helper's; not one of comments and layout."""
        folder, _ = lateral
        lab = tmp_path / "lab"
        shutil.copytree(folder, lab, ignore=shutil.ignore_patterns("fitted", "half", "__pycache__"))
        (lab / "factors.py").write_text("FACTOR = 1.0\n")
        text = MODEL.replace("import numpy as np", "import numpy as np\nfrom factors import FACTOR")
        (lab / "lateral.py").write_text(text.replace("-theta[0] * z", "-FACTOR * theta[0] * z"))
        model, own = lab / "fitted", ("--conf", lab)
        path = tmp_path / "data.parquet"
        flown = ("collect.duration=20", "collect.flight_duration=6", *QUICK)
        assert run("collect", *flown, "--out", path)[0] == 0
        assert run("fit", "lateral", path, *own, "--out", model)[0] == 0
        hover = ("trajectory=hover", "trajectory.duration=0.3", *QUICK)
        used = (
            ("simulate", "controller=nominal_mpc", "controller.residual=lateral", f"model={model}", *hover),
            ("simulate", "plant=from_model", f"plant.model={model}", "controller=nominal_mpc", *hover),
            ("evaluate", "controller=nominal_mpc", "controller.residual=lateral", f"model={model}", *hover),
            ("show", model),
        )

        def said(words):
            out = () if words[0] == "show" else ("--force", "--out", tmp_path / words[0])
            code, text, errors = run(*words, *own, *out)
            assert code == 0, errors
            return "fitted with other equations than lateral.py" in text + errors

        (lab / "factors.py").write_text('"""Of drag."""\n\nFACTOR = 1.0  # none\n')
        assert not any(map(said, used))
        (lab / "factors.py").write_text("FACTOR = 1.5\n")
        assert all(map(said, used))

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ("return -theta[0] * z[:3]@return -theta[0] * z[:2]", "acceleration gives the shape (2, 1); (3, 1)"),
            ("return [-(1@return [1.0, -(1", "estimate gives [1."),
            ("import numpy as np@import nonsense", "No module named 'nonsense'"),
            ("(Equation)@(object)", "is no part: it must be a class derived from quadexp.parts.part.Part"),
        ],
    )
    def test_a_mistake_is_one_line(self, change, said, data, tmp_path):
        folder = option(tmp_path / "lab", "model", "lateral", "lateral", MODEL.replace(*change.split("@")), "Lateral")
        code, _, error = run("fit", "lateral", data, "--conf", folder, "--out", tmp_path / "m")
        assert code == 2 and said in error and error.count("\n") == 1, error
        assert not (tmp_path / "m").exists()

    @needs("neural", "gaussian_process")
    def test_what_is_not_there_is_said(self, lateral, tmp_path):
        """Without its folder, under another name, or under one of this package."""
        folder, _ = lateral
        flown = [
            "controller=nominal_mpc",
            "controller.residual=laterl",
            "--conf",
            folder,
            "--out",
            tmp_path / "a.parquet",
        ]
        code, _, error = run("simulate", *flown)
        assert code == 2 and "controller.residual=laterl: must be one of none, plant," in error and "lateral" in error
        code, _, error = run("fit", "laterl", "x.parquet", "--conf", folder)
        assert code == 2 and "fit laterl: no such model; did you mean lateral?" in error
        taken = option(tmp_path / "lab", "model", "neural", "neural", MODEL, "Lateral")
        code, _, error = run("fit", "neural", "x.parquet", "--conf", taken)
        assert code == 2 and "this program has models of kind neural too: give neural.py another name" in error
        other = option(tmp_path / "other", "model", "mine", "equation_of_mine", MODEL, "Lateral")
        code, _, error = run("fit", "mine", "x.parquet", "--conf", other)
        assert code == 2 and "so an option model/equation_of_mine.yaml is needed" in error


class TestMetric:
    @pytest.fixture(scope="class")
    def results(self, tmp_path_factory):
        folder = tmp_path_factory.mktemp("metric")
        option(folder / "lab", "metric", "height_error", "height_of_mine", METRIC, "HeightError")
        words = ["controller=nominal_mpc,pid", "trajectory.speed=4", "seed=0,1", *QUICK[1:]]
        words += ["--conf", folder / "lab", "evaluate.metric=height_error", "--out", folder / "r"]
        code, out, error = run("evaluate", "--sweep", *words)
        assert code == 0 and "height error (mm)" in out, error
        return folder / "r"

    def test_tables_conditions_plots_and_the_page_follow(self, results, tmp_path):
        """Without the folder: the results say what the metric is."""
        code, out, error = run("results", results, "--where", "height_error > 0.001", "--format", "csv")
        assert code == 0, error
        code, out, error = run("results", results, "--columns", "controller,height_error", "--format", "json")
        values = [row["height_error"] for row in json.loads(out)["rows"]]
        assert len(values) == 4 and all(0 < value < 1 for value in values), error  # m
        assert run("plot", results, "--y", "height_error", "--out", tmp_path / "a.png")[0] == 0
        assert run("report", results, "--out", tmp_path / "page.html")[0] == 0
        assert "height error (mm)" in (tmp_path / "page.html").read_text()
        assert "height error (mm)" in (results / "table.md").read_text()
        assert "height error (mm)" in run("show", results)[1] and run("compare", results, results)[0] == 0

    def test_an_edit_changes_the_table_and_flies_nothing(self, results):
        folder = results.parent / "lab"
        file = folder / "height_of_mine.py"
        file.write_text(file.read_text().replace(".max()", ".max() * 0 + 0.25"))
        words = ["controller=nominal_mpc,pid", "trajectory.speed=4", "seed=0,1", *QUICK[1:]]
        words += ["--conf", folder, "evaluate.metric=height_error", "--no-figures", "--out", results, "--json"]
        code, out, error = run("evaluate", "--sweep", *words)
        assert code == 0 and json.loads(out)["flown"] == 0, error
        assert "250.0" in (results / "table.md").read_text()

    def test_mistakes_are_one_line(self, tmp_path):
        code, _, error = run("evaluate", "evaluate.metric=hight", "--out", tmp_path / "r")
        assert code == 2 and "evaluate.metric=hight: must be one of mean_error, rmse, max_error" in error
        bad = option(tmp_path / "lab", "metric", "bad", "bad_of_mine", METRIC.replace('"p_z"', '"p_q"'), "HeightError")
        short = ["controller=pid", "trajectory=hover", "trajectory.duration=0.2", "--conf", bad]
        code, _, error = run("evaluate", *short, "evaluate.metric=bad", "--out", tmp_path / "r")
        assert code == 2 and "metric=bad: of(flight): bad_of_mine.py, line " in error and error.count("\n") == 1, error
        nan = METRIC.replace("return ", "return np.nan * ")
        folder = option(tmp_path / "nan", "metric", "no_number", "no_number_of_mine", nan, "HeightError")
        words = ["evaluate", *short[:3], "--conf", folder, "evaluate.metric=no_number", "--no-figures"]
        code, out, error = run(*words, "--out", tmp_path / "r")
        assert code == 0 and "no_number is no number in 1 of 1 completed flights" in out, error
        taken = option(tmp_path / "taken", "metric", "rmse", "rmse_of_mine", METRIC, "HeightError")
        code, _, error = run("evaluate", *short[:3], "--conf", taken, "--out", tmp_path / "r")
        assert code == 2 and "metric=rmse: results have a column of that name" in error


LAB = '''
from pathlib import Path
from typing import Annotated
import numpy as np
from quadexp.cli.command import Answer, Ask, command

BRINGS = {
    "commands": {"laps": "my_lab:laps"},
    "readers": {"tabs": "my_lab:Tabs"},
    "sections": {"laps": "my_lab:lap_section"},
    "papers": {"mine": "my_lab"},
}

@command
def laps(flight: Annotated[Path, Ask("A flight.", "FLIGHT")]) -> Answer:
    """Count the laps of a flight."""
    import quadexp as qx
    table = qx.load(flight)
    angle = np.unwrap(np.arctan2(table["p_y"], table["p_x"]))
    count = float(abs(angle[-1] - angle[0]) / (2 * np.pi))
    return Answer({"laps": count}, [{"laps": count}], [f"{count:.2f} laps"])

class Tabs:
    """A log of time, position, velocity and attitude at rest, tab-separated, behind a line of its own."""
    ABOUT = "my lab's logger"
    MARK = b"#mylab"

    @classmethod
    def recognises(cls, path, head):
        return head is not None and head.startswith(cls.MARK)

    @staticmethod
    def read(path, named):
        from quadexp.plugins.logs.importers.raw import RawLog
        from quadexp.plugins.logs.signal import Stream
        t, *columns = np.loadtxt(path, delimiter="\\t", skiprows=1).T
        streams = {"position": columns[:3], "velocity": columns[3:6], "attitude": columns[6:10]}
        return RawLog("tabs", {name: Stream(t, np.stack(values, axis=1)) for name, values in streams.items()})

def lap_section(page):
    from quadexp.plugins.page.document import Block, Section
    from quadexp.report.table import Table
    rows = [[row["controller"], f"{row['duration']:.1f}"] for row in page.comparison.rows]
    return Section("laps", "Laps", "Laps of my lab", "", [Block(tables={"laps": Table(["controller", "s"], rows)})])

def draw(rows, out):
    return {"mine": f"{len(rows)} flights"}, {}
'''


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A module, and the entry point that pip would leave of it."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "my_lab.py").write_text(LAB)
    record = folder / "my_lab-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lab\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text("[quadexp.plugins]\nmy_lab = my_lab\n")
    return folder


def apart(folder, *words):
    """A command in a process with a package on its path."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-m", "quadexp", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder)


class TestPlugIn:
    def test_a_command(self, lab):
        assert run("simulate", "controller=pid", "trajectory.speed=4", "--out", lab / "a.parquet", "--force")[0] == 0
        done = apart(lab, "laps", "a.parquet", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["laps"] > 0.5
        assert (
            "Plug-ins:\n  laps" in apart(lab, "--help").stdout and "Count the laps" in apart(lab, "laps", "-h").stdout
        )

    @needs("logs", "check")
    def test_a_reader_of_logs(self, lab):
        import numpy as np

        t = np.arange(0, 12, 0.01)
        columns = [t, np.sin(t), np.cos(t), 1 + 0 * t, np.cos(t), -np.sin(t), 0 * t, 1 + 0 * t, 0 * t, 0 * t, 0 * t]
        np.savetxt(lab / "log.tabs", np.stack(columns, axis=1), delimiter="\t", header="mylab", comments="#")
        done = apart(lab, "import", "log.tabs", "--out", "flights", "--keep", "--no-crop", "--force")
        assert done.returncode in (0, 1) and (lab / "flights" / "log.parquet").is_file(), done.stderr
        done = apart(lab, "import", "log.tabs", "--log-format", "nothing", "--out", "other")
        assert done.returncode == 2 and "no such format" in done.stderr and "tabs" in done.stderr

    @needs("page")
    def test_a_section_of_the_page_and_a_paper(self, lab):
        words = ["controller=nominal_mpc,pid", "trajectory=hover", "trajectory.duration=0.5", "evaluate.figures=mine"]
        done = apart(lab, "evaluate", "--sweep", *words, "--out", "r")
        assert done.returncode == 0 and (lab / "r" / "mine.md").read_text().strip() == "2 flights", done.stderr
        done = apart(lab, "report", "r", "--out", "page.html", "--force")
        page = (lab / "page.html").read_text()
        assert (
            done.returncode == 0 and "Laps of my lab" in page and page.index("Numbers") < page.index("Laps of my lab")
        )

    @pytest.mark.parametrize(
        ("text", "words", "said"),
        [
            ("", ["--help"], "entry point 'my_lab' of quadexp.plugins: module my_lab has no BRINGS"),
            ("import nonsense", ["laps"], "importing my_lab raised ModuleNotFoundError: No module named 'nonsense'"),
            ("BRINGS = {'colours': {}}", ["--help"], "BRINGS['colours']: no such seam; there are commands, parts"),
            ("BRINGS = {'commands': {'show': 'my_lab:x'}}", ["--help"], "'show' is taken: choose another name"),
            ("BRINGS = {'commands': {'laps': 'my_lab:x'}}", ["laps"], "laps: my_lab:x: module 'my_lab' has no"),
            ("x = 3\nBRINGS = {'commands': {'laps': 'my_lab:x'}}", ["laps"], "command laps: my_lab:x is no command of"),
            ("x = 3\nBRINGS = {'readers': {'tabs': 'my_lab:x'}}", ["import", "a.log"], "my_lab:x has no ABOUT"),
            (
                LAB.replace('flight: Annotated[Path, Ask("A flight.", "FLIGHT")]', "flight: Path"),
                ["laps", "a.log"],
                "command laps: flight needs a type: flight: Annotated[TYPE, Ask(TEXT)]",
            ),
            (
                LAB.replace("    import quadexp as qx\n", "    return 3\n"),
                ["laps", "a.log"],
                "command laps: must return an Answer, not int",
            ),
        ],
    )
    @needs()
    def test_a_mistake_is_one_line_and_hinders_nothing_that_ships(self, text, words, said, lab, tmp_path):
        folder = tmp_path / "site"
        record = folder / "my_lab-1.0.dist-info"
        record.mkdir(parents=True)
        (folder / "my_lab.py").write_text(text)
        (record / "entry_points.txt").write_text("[quadexp.plugins]\nmy_lab = my_lab\n")
        (folder / "a.log").write_bytes(b"\x00\x01")
        done = apart(folder, *words)
        assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1, done.stderr
        assert apart(folder, "options", "wind").returncode == 0

    @needs("logs", "check")
    def test_what_a_reader_gives_is_checked(self, lab, tmp_path):
        rows = "\n".join("\t".join([str(k), *"0000001000"]) for k in range(9))
        (tmp_path / "a.tabs").write_text(f"#mylab\n{rows}\n")
        shutil.copytree(lab / "my_lab-1.0.dist-info", tmp_path / "my_lab-1.0.dist-info")
        for before, after, said in (
            ('"position"', '"positon"', "a stream cannot be called 'positon'; did you mean position?"),
            ("t, *columns =", "*columns, t =", "position: its times must be finite numbers"),
        ):
            (tmp_path / "my_lab.py").write_text(LAB.replace(before, after))
            done = apart(tmp_path, "import", "a.tabs", "--out", "flights")
            assert done.returncode == 1 and f"reader tabs: {said}" in done.stdout, done.stdout + done.stderr
