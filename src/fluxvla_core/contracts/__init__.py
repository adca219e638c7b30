"""The contracts between the core and its plugins."""

from fluxvla_core.contracts.frame import STATE, Frame, Observation, Sample
from fluxvla_core.contracts.protocols import (
    API,
    Clock,
    Command,
    Dataset,
    Operator,
    Policy,
    RandomTransform,
    Runner,
    TrainRunner,
    Transform,
)
from fluxvla_core.contracts.reporter import Reporter, SilentReporter

__all__ = [
    "API",
    "STATE",
    "Clock",
    "Command",
    "Dataset",
    "Frame",
    "Observation",
    "Operator",
    "Policy",
    "RandomTransform",
    "Reporter",
    "Runner",
    "Sample",
    "SilentReporter",
    "TrainRunner",
    "Transform",
]
