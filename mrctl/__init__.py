"""A physics testbed for adaptive control of a car-like robot."""

from mrctl.control.composite import Composite
from mrctl.control.fel import Fel, save_weights
from mrctl.control.guard import Guard
from mrctl.control.kanayama import Kanayama
from mrctl.control.observer import Observer
from mrctl.control.pid import Pid
from mrctl.control.rls import Rls
from mrctl.metrics import guard_events, per_lap, summary
from mrctl.model import load_robot
from mrctl.record import InputError
from mrctl.references import Circle, LaneChange, Lemniscate, Line, RoundedSquare, StopAndGo, Waypoints
from mrctl.result import save
from mrctl.robot import PERTURBATIONS, Perturbation, Robot, RobotFile
from mrctl.scenario import Event, Scenario
from mrctl.simulate import Simulation, simulate
from mrctl.store import open_store as open
from mrctl.sweep import Axis, Sweep

__all__ = [
    "PERTURBATIONS",
    "Axis",
    "Circle",
    "Composite",
    "Event",
    "Fel",
    "Guard",
    "InputError",
    "Kanayama",
    "LaneChange",
    "Lemniscate",
    "Line",
    "Observer",
    "Perturbation",
    "Pid",
    "Rls",
    "Robot",
    "RobotFile",
    "RoundedSquare",
    "Scenario",
    "Simulation",
    "StopAndGo",
    "Sweep",
    "Waypoints",
    "guard_events",
    "load_robot",
    "open",
    "per_lap",
    "save",
    "save_weights",
    "simulate",
    "summary",
]
