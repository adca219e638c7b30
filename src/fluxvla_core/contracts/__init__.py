"""The contracts between the core and its plugins."""

from fluxvla_core.contracts.continuation import Continuation
from fluxvla_core.contracts.environment import Actor, Environment, EnvironmentSpec, Step, TaskSpec
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
    "Actor",
    "Clock",
    "Command",
    "Continuation",
    "Dataset",
    "Environment",
    "EnvironmentSpec",
    "Frame",
    "Observation",
    "Operator",
    "Policy",
    "RandomTransform",
    "Reporter",
    "Runner",
    "Sample",
    "SilentReporter",
    "Step",
    "TaskSpec",
    "TrainRunner",
    "Transform",
]
