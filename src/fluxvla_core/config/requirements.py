"""``requires = ["fluxvla-ur>=0.3"]``: distributions that a config says it needs (PEP 508)."""

from __future__ import annotations

from fluxvla_core.config import keys
from fluxvla_core.config.tree import Config
from fluxvla_core.errors import Problem
from fluxvla_core.plugins._metadata import canonical, version
from fluxvla_core.plugins.known import FIRST_PARTY

KEY = "requires"


def requirement_problems(config: Config) -> list[Problem]:
    """One problem for each requirement of ``config`` that does not hold or cannot be read."""
    wanted = config.tree.get(KEY)
    if wanted is None:
        return []
    if not isinstance(wanted, list) or not all(isinstance(text, str) for text in wanted):
        return [config.problem(KEY, f"must be a list like ['fluxvla-ur>=0.3'], got {wanted!r}")]
    found = [(keys.child(KEY, i), _unmet(text)) for i, text in enumerate(wanted)]
    return [config.problem(key, what) for key, what in found if what]


def _unmet(text: str) -> str | None:
    from packaging.requirements import InvalidRequirement, Requirement

    try:
        requirement = Requirement(text)
    except InvalidRequirement as error:
        return f"{text!r} is no requirement (PEP 508): {str(error).splitlines()[0]}"
    if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
        return None
    have = version(requirement.name)
    if have is None:
        command = f": pip install {requirement.name}"
        # Only names that we ship are put into a command; see plugins.known.
        return f"needs {text}, which is not installed" + (
            command if canonical(requirement.name) in FIRST_PARTY else ""
        )
    if not requirement.specifier.contains(have, prereleases=True):
        return f"needs {text}, but {requirement.name} {have} is installed"
    return None
