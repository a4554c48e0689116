# What type checkers and editors see of quadexp/__init__.py, which imports these names when they are first used.
from quadexp.api import collect as collect
from quadexp.api import fit as fit
from quadexp.api import fit_drag as fit_drag
from quadexp.api import load as load
from quadexp.api import simulate as simulate
from quadexp.api import sweep as sweep
from quadexp.control.base import Measurement as Measurement
from quadexp.control.base import Window as Window
from quadexp.errors import DataError as DataError
from quadexp.errors import QuadexpError as QuadexpError
from quadexp.errors import UsageError as UsageError
from quadexp.frames import Checkpoint as Checkpoint
from quadexp.frames import Dataset as Dataset
from quadexp.frames import Flight as Flight
from quadexp.frames import Results as Results
from quadexp.loop import ControlLoop as ControlLoop
from quadexp.loop import controller as controller

__version__: str
from quadexp.plugins.bench.api import Leaderboard as Leaderboard
from quadexp.plugins.bench.api import bench as bench
from quadexp.plugins.gaussian_process.api import fit_gp as fit_gp
from quadexp.plugins.neural.api import fit_nn as fit_nn
from quadexp.plugins.tune.api import Tuning as Tuning
from quadexp.plugins.tune.api import tune as tune
