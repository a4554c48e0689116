# What type checkers and editors see of quadexp/__init__.py, which imports these names when they are first used.
from quadexp.api.calls import bench as bench
from quadexp.api.calls import collect as collect
from quadexp.api.calls import fit_drag as fit_drag
from quadexp.api.calls import fit_gp as fit_gp
from quadexp.api.calls import fit_nn as fit_nn
from quadexp.api.calls import load as load
from quadexp.api.calls import simulate as simulate
from quadexp.api.calls import sweep as sweep
from quadexp.api.calls import tune as tune
from quadexp.api.checkpoint import Checkpoint as Checkpoint
from quadexp.api.frames import Dataset as Dataset
from quadexp.api.frames import Flight as Flight
from quadexp.api.frames import Leaderboard as Leaderboard
from quadexp.api.frames import Results as Results
from quadexp.api.frames import Tuning as Tuning
from quadexp.api.loop import ControlLoop as ControlLoop
from quadexp.api.loop import controller as controller
from quadexp.control.base import Measurement as Measurement
from quadexp.control.base import Window as Window
from quadexp.errors import DataError as DataError
from quadexp.errors import QuadexpError as QuadexpError
from quadexp.errors import UsageError as UsageError

__version__: str
