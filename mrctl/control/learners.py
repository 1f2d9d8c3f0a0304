"""The learners, by the names that scenarios give them."""

from typing import Literal

from mrctl.control.composite import CompositeAdaptation
from mrctl.control.feedforward import Learner, NoLearner
from mrctl.control.fel import FeedbackErrorLearning
from mrctl.control.indi import IncrementalInversion
from mrctl.control.l1 import L1Adaptive
from mrctl.control.mrac import ModelReferenceAdaptive
from mrctl.control.observer import DisturbanceObserver
from mrctl.control.rls import RecursiveLeastSquares

LearnerName = Literal["none", "observer", "indi", "l1", "fel", "rls", "mrac", "composite"]
LEARNERS: dict[LearnerName, type[Learner]] = {
    "none": NoLearner,
    "observer": DisturbanceObserver,
    "indi": IncrementalInversion,
    "l1": L1Adaptive,
    "fel": FeedbackErrorLearning,
    "rls": RecursiveLeastSquares,
    "mrac": ModelReferenceAdaptive,
    "composite": CompositeAdaptation,
}
"""Except for `none`, the settings of a learner are the field of `Scenario` with its name."""
