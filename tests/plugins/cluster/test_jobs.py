"""Jobs of a queueing system, by programs that take the place of sbatch and qsub and run the script of a job here."""

import gc
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("dask_jobqueue", reason="the extra `cluster` is not installed")
pytest.importorskip("cryptography", reason="the extra `cluster` is not installed")

from quadexp.errors import QuadexpError
from quadexp.parts.compose import compose, expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.experiment.same import same_results
from tests.plugins.cluster.dask_cluster import ROOT
from tests.sweeps import cells
from tests.sweeps.cells import built_engine

GRID = "seed=range(6)"
# Runs the script, whose name comes last, in a folder of another name, notes it, and says the number of the job.
SUBMIT = """#!/bin/sh
for last; do :; done
mkdir -p {folder}/job; cp $last {folder}/script.$$
(cd {folder}/job; unset PYTHONSAFEPATH; exec setsid bash {folder}/script.$$ >/dev/null 2>&1) &
echo $! >> {folder}/pids
echo {said}
"""
REFUSE = "#!/bin/sh\nfor last; do :; done\ncp $last {folder}/script\necho the queue is closed >&2\nexit 1\n"


@pytest.fixture
def queue(tmp_path, monkeypatch):
    """A function that puts a queue's programs on the PATH; returns what says that the interface is the loopback."""
    programs = tmp_path / "programs"
    programs.mkdir()
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def put(**contents):
        for name, content in contents.items():
            (programs / name).write_text(content)
            (programs / name).chmod(0o755)

    yield put
    for pid in (tmp_path / "pids").read_text().split() if (tmp_path / "pids").exists() else ():
        subprocess.run(["kill", "--", f"-{pid}"], check=False, capture_output=True)


def engine_of(*overrides, **options):
    given = ",".join(f"{name}: {value}" for name, value in {"interface": "lo", **options}.items())
    return built_engine(compose(["engine=jobs", "evaluate.workers=2", f"engine.options={{{given}}}", *overrides]))


@pytest.mark.parametrize(
    ("system", "program", "said"),
    [("slurm", "sbatch", "Submitted batch job $!"), pytest.param("pbs", "qsub", "$!.head", marks=pytest.mark.slow)],
)
def test_the_same_results_as_at_home(queue, tmp_path, system, program, said):
    cancel = "#!/bin/sh\nkill -- -${1%%.*}\n"
    queue(**{program: SUBMIT.format(folder=tmp_path, said=said), "scancel": cancel, "qdel": cancel})
    shared = tmp_path / "shared"
    shared.mkdir(mode=0o700)
    seen = set()

    def look(done, total):
        seen.update(stat.S_IMODE(path.stat().st_mode) for path in shared.iterdir())

    engine = engine_of(f"engine.system={system}", "engine.wait=120", shared_temp_directory=shared)
    away = run_sweep(
        expand([GRID]), tmp_path / "away", SweepRequest(function=cells.quick_cell, engine=engine, progress=look)
    )
    assert away.flown == 6 and not away.not_flown
    same_results(run_sweep(expand([GRID]), tmp_path / "home", SweepRequest(function=cells.quick_cell, workers=1)), away)
    assert seen == {0o600}, "certificates that others may read"
    del engine
    gc.collect()
    assert not list(shared.iterdir()), "a key is left behind"
    assert "tls://" in next(tmp_path.glob("script.*")).read_text()


def test_what_a_queue_refuses_is_said_before_anything_is_flown(queue, tmp_path):
    """The script is kept: what it runs imports nothing from the folder where the job starts."""
    seen = tmp_path / "seen"
    queue(
        sbatch=REFUSE.format(folder=tmp_path),
        python=f'#!/bin/sh\n{sys.executable} -c "import sys; print(sys.path)" > {seen}\n',
    )
    with pytest.raises(QuadexpError, match="engine=jobs is not found: the queue is closed"):
        run_sweep(
            expand([GRID]), tmp_path / "r", SweepRequest(engine=engine_of(python=tmp_path / "programs" / "python"))
        )
    assert not (tmp_path / "r").exists()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    subprocess.run(["bash", str(tmp_path / "script")], cwd=tmp_path, env=environment, check=True)
    assert "''" not in seen.read_text() and str(tmp_path) not in seen.read_text()


@pytest.mark.parametrize(
    ("options", "says"), [({"cores": 4}, "multiple values for .*'cores'"), ({"nodes": 4}, "nodes")]
)
def test_options_that_are_not_for_the_user(queue, tmp_path, options, says):
    queue(sbatch=REFUSE.format(folder=tmp_path))
    with pytest.raises(QuadexpError, match=says) as error:
        run_sweep(expand([GRID]), tmp_path / "r", SweepRequest(engine=engine_of(**options)))
    assert "\n" not in str(error.value) and not (Path(tmp_path) / "script").exists()
