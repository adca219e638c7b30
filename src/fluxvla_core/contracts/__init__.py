"""The contracts between the core and its plugins, as base classes."""

from fluxvla_core.contracts.checkpoint_format import CheckpointFormat, ForeignCheckpoint
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, Step, TaskSpec
from fluxvla_core.contracts.frame import STATE, Frame, Observation, Sample
from fluxvla_core.contracts.policy import Actor, Continuation, Policy
from fluxvla_core.contracts.robot import ActionFilter, Clock, Operator, Part
from fluxvla_core.contracts.runner import (
    Command,
    Hook,
    Reporter,
    Runner,
    SilentReporter,
    TrainRunner,
)
from fluxvla_core.contracts.training import (
    VLA,
    Collator,
    Dataset,
    InferenceDataset,
    Metric,
    Optimizer,
    RandomTransform,
    Tokenizer,
    Transform,
)

__all__ = [
    "STATE",
    "VLA",
    "ActionFilter",
    "Actor",
    "CheckpointFormat",
    "Clock",
    "Collator",
    "Command",
    "Continuation",
    "Dataset",
    "Environment",
    "EnvironmentSpec",
    "ForeignCheckpoint",
    "Frame",
    "Hook",
    "InferenceDataset",
    "Metric",
    "Observation",
    "Operator",
    "Optimizer",
    "Part",
    "Policy",
    "RandomTransform",
    "Reporter",
    "Runner",
    "Sample",
    "SilentReporter",
    "Step",
    "TaskSpec",
    "Tokenizer",
    "TrainRunner",
    "Transform",
]
