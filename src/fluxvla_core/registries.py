"""The table of registries: every kind of class that a plugin may provide.

Everything else follows from it: the entry-point groups (``fluxvla.runners``), the registries
(``RUNNERS``), the build functions (``build_runner_from_cfg``), the contract that a class is checked
against, the versions of the contracts, and what ``fluxvla_core`` exports. A new registry is one
line here.

It imports next to nothing: ``import fluxvla_core`` and the scan of installed packages read it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

PREFIX = "fluxvla."
"""Prefix of every entry-point group."""

_ROBOT = "fluxvla_core.contracts.robot"
_POLICY = "fluxvla_core.contracts.policy"
_TRAINING = "fluxvla_core.contracts.training"
_ENVIRONMENT = "fluxvla_core.contracts.environment"
_RUNNER = "fluxvla_core.contracts.runner"
_FORMAT = "fluxvla_core.contracts.checkpoint_format"


class RegistryRow(NamedTuple):
    """Description of one registry.

    Args:
        name: in messages and code; the entry-point group is ``fluxvla.<name>``.
        kind: singular, for the name of its build function; None if it has none.
        contract: ``module:class`` of the base class; None for classes that only their own plugin
            calls.
        about: description of its classes.
        api: version of the contract that this core speaks. A class declares ``api = "1.0"``: the
            same major and no newer minor is accepted.
    """

    name: str
    kind: str | None
    contract: str | None
    about: str
    api: str = "1.0"

    @property
    def group(self) -> str:
        """The entry-point group."""
        return PREFIX + self.name

    @property
    def constant(self) -> str:
        """The registry's own name in code: ``RUNNERS``."""
        return self.name.upper()

    @property
    def builder(self) -> str | None:
        """The build function's name: ``build_runner_from_cfg``."""
        return self.kind and f"build_{self.kind}_from_cfg"


ROWS = (
    RegistryRow("runners", "runner", f"{_RUNNER}:Runner", "runner: what a section runs"),
    RegistryRow("operators", "operator", f"{_ROBOT}:Operator", "operator: a robot"),
    RegistryRow("vlas", "vla", f"{_TRAINING}:VLA", "VLA model"),
    RegistryRow("vision_backbones", "vision_backbone", None, "part of a model"),
    RegistryRow("llm_backbones", "llm_backbone", None, "part of a model"),
    RegistryRow("vlm_backbones", "vlm_backbone", None, "part of a model"),
    RegistryRow("projectors", "projector", None, "part of a model"),
    RegistryRow("heads", "head", None, "part of a model"),
    RegistryRow("datasets", "dataset", f"{_TRAINING}:Dataset", "dataset"),
    RegistryRow("transforms", "transform", f"{_TRAINING}:Transform", "transform: changes a sample"),
    RegistryRow("collators", "collator", f"{_TRAINING}:Collator", "collator: samples to a batch"),
    RegistryRow("tokenizers", "tokenizer", f"{_TRAINING}:Tokenizer", "tokenizer"),
    RegistryRow("processors", "processor", None, "processor"),
    RegistryRow("metrics", "metric", f"{_TRAINING}:Metric", "metric: logs training steps"),
    RegistryRow("optimizers", "optimizer", f"{_TRAINING}:Optimizer", "optimizer"),
    RegistryRow("action_filters", "action_filter", f"{_ROBOT}:ActionFilter", "action filter"),
    RegistryRow("hooks", None, f"{_RUNNER}:Hook", "hook: observes a run"),
    RegistryRow(
        "environments",
        "environment",
        f"{_ENVIRONMENT}:Environment",
        "environment: a simulator",
    ),
    RegistryRow("policies", "policy", f"{_POLICY}:Policy", "policy"),
    RegistryRow(
        "checkpoint_formats",
        None,
        f"{_FORMAT}:CheckpointFormat",
        "checkpoint format of another project",
    ),
    RegistryRow("commands", None, f"{_RUNNER}:Command", "command of the CLI"),
)

BY_NAME = {row.name: row for row in ROWS}
REGISTRIES = tuple(BY_NAME)
GROUPS = tuple(row.group for row in ROWS)


def check_api(registry: str, name: str, written: Any, origin: str) -> None:
    """Caret check of the version of a contract that a class was written for.

    Args:
        name: the class's.
        written: its ``api``; a class without one (None) is taken as is.

    Raises:
        IncompatiblePlugin: too old or too new, with the upgrade that fixes it.
    """
    from fluxvla_core.errors import IncompatiblePlugin

    speaks = BY_NAME[registry].api
    if written is None:
        return
    have, want = _version(speaks), _version(str(written))
    if want is None or have is None:
        raise IncompatiblePlugin(f"{origin}: {name}.api = {written!r} is not a version")
    if want == have or (want[0] == have[0] and want[1] <= have[1] and have[0] > 0):
        return
    upgrade = "fluxvla-core" if want > have else origin.partition(" ")[0]
    raise IncompatiblePlugin(
        f"{origin}: {name} is written for {registry} {written}, this core speaks {speaks}",
        next=f"pip install --upgrade {upgrade}",
    )


def _version(text: str) -> tuple[int, int] | None:
    major, _, minor = text.partition(".")
    if not (major.isdigit() and (minor or "0").isdigit()):
        return None
    return int(major), int(minor or 0)
