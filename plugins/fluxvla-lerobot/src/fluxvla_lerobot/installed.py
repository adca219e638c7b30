"""The installed LeRobot: which versions are known, and the few parts of it that are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from packaging.version import InvalidVersion, Version

from fluxvla_core.errors import LoadFailed

KNOWN = "0.4.4 to 0.6"
"""Tested with 0.4.4 and 0.6.1, in words for messages."""
LEAST, BELOW = Version("0.4.4"), Version("0.7.dev0")
INSTALL = "pip install 'fluxvla-lerobot[lerobot]' (LeRobot 0.6 is for Python 3.12 or newer)"


@dataclass(frozen=True)
class LeRobot:
    """The parts of LeRobot that are used.

    Args:
        version: of the distribution.
        config_class: ``PreTrainedConfig``, whose subclasses are the known policies.
        policy_class: the class of a policy's ``type``; imports its module.
        processors: makes a policy's pre- and postprocessor.
        raw_batch: images, states and an instruction as LeRobot's robots give them.
        normalizers: the classes of steps that normalise or undo it.
    """

    version: str
    config_class: Any
    policy_class: Callable[[str], Any]
    processors: Callable[..., tuple[Any, Any]]
    raw_batch: Callable[..., dict[str, Any]]
    normalizers: tuple[type, ...]


def known_version(installed: str | None) -> str:
    """The version ``installed``, if it is one that is known here.

    Raises:
        LoadFailed: it is None, or another one.
    """
    if installed is None:
        raise LoadFailed(
            "LeRobotPolicy needs LeRobot, which is not installed",
            next=INSTALL,
        )
    try:
        fits = LEAST <= Version(installed) < BELOW
    except InvalidVersion:
        fits = False
    if not fits:
        raise LoadFailed(
            f"LeRobot {installed} is installed; LeRobotPolicy knows {KNOWN}",
            cause="its functions have other names or arguments from one version to the next",
            next=INSTALL,
        )
    return installed


def installed_version() -> str | None:
    """The version of the installed LeRobot; None if there is none."""
    try:
        return metadata.version("lerobot")
    except metadata.PackageNotFoundError:
        return None


def lerobot() -> LeRobot:
    """Import LeRobot, with the policies that other packages add to it.

    Raises:
        LoadFailed: it is not installed, of a version that is not known, or cannot be imported.
    """
    version = known_version(installed_version())
    try:
        import lerobot.policies.factory as factory
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.utils import prepare_observation_for_inference
        from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep
        from lerobot.utils.import_utils import register_third_party_plugins
    except ImportError as error:
        raise LoadFailed(
            f"LeRobot {version} cannot be imported: {error}",
            cause="it was installed without what it needs, or beside other versions of it",
            next=f"{INSTALL}, in an environment of its own",
        ) from error
    register_third_party_plugins()
    return LeRobot(
        version=version,
        config_class=PreTrainedConfig,
        policy_class=factory.get_policy_class,
        processors=factory.make_pre_post_processors,
        raw_batch=prepare_observation_for_inference,
        normalizers=(NormalizerProcessorStep, UnnormalizerProcessorStep),
    )
