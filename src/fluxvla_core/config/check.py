"""Check a whole config against the classes that it names, without importing anything.

Only keys and classes are checked. Types of values are left to the constructors: annotations are
too often wrong to refuse a config by them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fluxvla_core.config.parameters import Parameter
from fluxvla_core.config.resolve import (
    INJECTED,
    LOADER_KEYS,
    LOADERS,
    SECTIONS,
    SLOTS,
    Found,
    resolve,
)
from fluxvla_core.config.signature import Signature, table_of
from fluxvla_core.config.similar_keys import similar_key, unit_note
from fluxvla_core.config.tree import Config, all_keys, join_key
from fluxvla_core.errors import ConfigError, MissingPlugin, PluginError, Problem, nearest
from fluxvla_core.plugins._metadata import canonical, version
from fluxvla_core.plugins.first_party import FIRST_PARTY
from fluxvla_core.plugins.load import LIST

REQUIRES = "requires"
"""The key of the distributions that a config needs (PEP 508): ``["fluxvla-ur>=0.3"]``."""
# ``inference_model`` is in configs of upstream FluxVLA. Nothing is built from it here: a policy is
# built from the checkpoint's ``model``. Its classes are checked like any others.
_NAMED = (*SECTIONS, "model", "inference_model", *LOADERS, REQUIRES, "hooks")
# Keys under which a table without ``type`` can only be a slip.
_NEEDS_TYPE = frozenset(SLOTS) - {"dataset", "datasets", "hooks", "action_filters"}


@dataclass(frozen=True)
class Use:
    """One class that the config names: its key, registry and provider."""

    key: str
    found: Found


@dataclass(frozen=True)
class Checked:
    """Result of a check.

    Args:
        sections: names of the runnable sections (tables whose ``type`` is a runner).
        trains: those of them that train.
        uses: every class that is named.
        problems: empty if the config is good.
        missing: whether one of them is a plugin that is not installed.
    """

    sections: tuple[str, ...]
    trains: frozenset[str]
    uses: tuple[Use, ...]
    problems: tuple[Problem, ...]
    missing: bool = False

    def error(self) -> ConfigError:
        """All problems as one error."""
        return ConfigError.from_problems(self.problems, next=LIST if self.missing else None)


def check_config(config: Config, section: str | None = None) -> Checked:
    """:func:`examine`, with all problems raised as one ConfigError."""
    checked = examine(config, section)
    if checked.problems:
        raise checked.error()
    return checked


def examine(config: Config, section: str | None = None) -> Checked:
    """The problems of ``config`` and the classes that it uses, without importing a plugin.

    Args:
        section: check for running this one. Plugins that only other sections need may then be
            missing: a robot's computer needs no training plugin to run ``inference``.
    """
    walk = _Walk(config)
    for name, value in config.tree.items():
        walk.top(name, value)
    problems = walk.problems + _requirement_problems(config)
    sections = tuple(walk.sections)
    trains = frozenset(walk.trains)
    for name in sections:
        if name in trains and section in (None, name):
            problems += _loader_problems(config, name)
    missing = walk.missing
    # Where a section's runner is missing, only its being asked for shows that it is a section.
    asked = section is not None and type_key(section) in {p.key for p in missing}
    if section is not None and (section in sections or asked):
        needed = _needed(config, section, section not in walk.runs, sections)
        missing = [p for p in missing if p.key.partition(".")[0] in needed]
    order = {p: i for i, p in enumerate(all_keys(config.tree))}
    problems = sorted([*problems, *missing], key=lambda p: order.get(p.key, -1))
    return Checked(sections, trains, tuple(walk.uses), tuple(problems), bool(missing))


def type_key(section: str) -> str:
    """The key that names the runner of ``section``."""
    return join_key(join_key("", section), "type")


def _needed(config: Config, section: str, trains: bool, sections: tuple[str, ...]) -> set[str]:
    """Top-level names whose plugins must be installed to run ``section``.

    Inference and evaluation take their model from a checkpoint or a server; training, or a section
    that may train because its runner is missing, needs the config's own.
    """
    if not trains:
        return {section, "hooks"}
    return {name for name in config.tree if name == section or name not in sections}


def _loader_problems(config: Config, section: str) -> list[Problem]:
    loader = config.tree.get("train_dataloader")
    if loader is None:
        what = f"{section!r} trains, and there is no train_dataloader = dict(dataset=dict(...))"
        return [config.problem(section, what)]
    if not isinstance(loader, dict):
        return []
    found = []
    if not isinstance(loader.get("dataset"), dict):
        found.append(config.problem("train_dataloader", "needs dataset = dict(type=...)"))
    for name in loader.keys() - set(LOADER_KEYS):
        # Another runner may read keys of its own; one that nearly is one of ours is a typo.
        near = similar_key(name, LOADER_KEYS, 0.75)
        if near:
            key = join_key("train_dataloader", name)
            found.append(config.problem(key, f"unknown key; did you mean {near!r}?"))
    return found


class _Walk:
    def __init__(self, config: Config) -> None:
        self.config = config
        self.problems: list[Problem] = []
        self.missing: list[Problem] = []  # plugins that are not installed
        self.sections: list[str] = []
        self.trains: list[str] = []
        self.runs: list[str] = []  # sections that are known not to train
        self.uses: list[Use] = []

    def add(self, key: str, what: str) -> None:
        self.problems.append(self.config.problem(key, what))

    def top(self, name: str, value: Any) -> None:
        """One top-level name: a section, a known table, or a variable to compose from."""
        key = join_key("", name)
        if name in LOADERS:
            if isinstance(value, dict):
                self.children(key, value, whole=True)
            elif value is not None:
                self.add(key, f"must be a table, got {value!r}")
        elif name in SLOTS:
            self.value(key, value, name, whole=True)
        elif isinstance(value, dict) and "type" not in value:
            near = nearest(name, _NAMED, 0.8)
            if near:
                self.add(
                    key,
                    f"no section of that name; did you mean {near!r}? (if it is a variable of "
                    "your own, give it a name that looks less like one)",
                )
            self.children(key, value, whole=False)
        else:
            self.value(key, value, name, whole=False)

    def children(self, key: str, table: dict[str, Any], whole: bool) -> None:
        for name, value in table.items():
            if name != "type":
                self.value(join_key(key, name), value, name, whole)

    def value(self, key: str, value: Any, slot: str, whole: bool) -> None:
        """Check ``value``.

        Args:
            slot: the name of the key of ``value``, or of the list that it is in.
            whole: False in variables, which a config may complete elsewhere.
        """
        registry = SLOTS.get(slot)
        if isinstance(value, list):
            for index, item in enumerate(value):
                self.value(join_key(key, index), item, slot, whole)
        elif registry == "hooks" and isinstance(value, str):
            self.component(key, {"type": value}, registry, whole, at=key)
        elif isinstance(value, dict):
            if "type" in value:
                self.component(key, value, registry, whole, at=join_key(key, "type"))
                return
            if whole and slot in _NEEDS_TYPE and value:
                self.add(key, f"this table needs type = '<one of fluxvla.{registry}>'")
            self.children(key, value, whole)
        elif whole and value is not None and (slot == "transforms" or key in _NEEDS_TYPE):
            self.add(
                key, f"must be a table with type = '<one of fluxvla.{registry}>', got {value!r}"
            )

    def component(
        self, key: str, table: dict[str, Any], registry: str | None, whole: bool, at: str
    ) -> None:
        """One table that is built; ``at`` is the key of its type's name."""
        kind = table["type"]
        if not isinstance(kind, str):
            self.add(at, f"type must be a class's name in quotes, got {kind!r}")
            self.children(key, table, whole)
            return
        try:
            resolved = resolve(kind, registry)
        except PluginError as error:
            text = error.what.partition("\n")[0]
            if error.next and error.next != LIST:
                text += f": {error.next}"
            problem = self.config.problem(at, text)
            (self.missing if isinstance(error, MissingPlugin) else self.problems).append(problem)
            if registry == "runners" and "." not in key:
                self.sections.append(key)
        else:
            if resolved.registry == "runners" and "." not in key:
                self.sections.append(key)
                whole = True
                if resolved.signature:
                    (self.trains if resolved.signature.trains else self.runs).append(key)
            self.uses.append(Use(key, resolved))
            if resolved.signature is not None:
                self.arguments(key, table, resolved.signature, whole)
        self.children(key, table, whole)

    def arguments(self, key: str, table: dict[str, Any], signature: Signature, whole: bool) -> None:
        given = [name for name in table if name != "type"]
        for name in given:
            inner = join_key(key, name)
            if name in INJECTED:
                self.add(inner, f"{name!r} is filled in when the run starts and cannot be set")
            elif name not in signature.names and not signature.open:
                self.add(inner, self._unknown(key, name, signature, table))
        for parameter in signature.parameters:
            self.inside(join_key(key, parameter.name), table.get(parameter.name), parameter)
        lacking = [
            p.name
            for p in signature.parameters
            if p.required and p.name not in given and p.name not in INJECTED
        ]
        if lacking and whole:
            self.add(
                key,
                f"{signature.name} needs {', '.join(map(repr, lacking))} "
                f"(defined at {signature.place})",
            )

    def inside(self, key: str, value: Any, parameter: Parameter) -> None:
        """Keys of a table without a type, where the annotation of its parameter names them."""
        if not isinstance(value, dict) or "type" in value:
            return
        table = table_of(parameter)
        if table is None:
            return
        for name in value:
            if name not in table.names:
                self.add(join_key(key, name), self._unknown(key, name, table, value))
        for field in table.parameters:
            self.inside(join_key(key, field.name), value.get(field.name), field)

    def _unknown(self, key: str, name: str, signature: Signature, table: dict[str, Any]) -> str:
        places = {p.name: p.place for p in signature.parameters if p.name not in INJECTED}
        near = similar_key(name, places)
        text = f"{signature.name} takes no {name!r}"
        # A train runner's loader has a table of its own.
        loader = similar_key(name, LOADER_KEYS, 1.0) if "collator" in places else None
        if not near and loader:
            text += f"; did you mean train_dataloader.{loader}?"
        elif not near:
            text += f" (defined at {signature.place})"
        elif near in table:
            # Inherited, more often than not, so that a misspelt key stands next to the right one.
            set_at = self.config.where(join_key(key, near))
            text += f"; did you mean {near!r}? (set at {set_at})"
        else:
            note = unit_note(name, near)
            text += f"; did you mean {near!r}{f', {note}' if note else ''}?"
            text += f" (defined at {places[near]})"
        history = self._left_over(key, name)
        return f"{text}; {'or ' if near else ''}{history}" if history else text

    def _left_over(self, key: str, name: str) -> str:
        """Advice for a key that was written for another class; empty if it was not."""
        here, there = (self.config.where(join_key(key, n)) for n in (name, "type"))
        if _typed(here):
            return ""
        text = f"it was written for the class that {there} replaced: "
        if _typed(there):
            return f"{text}set the whole table: --set '{key}={{type = ...}}'"
        if join_key(key, name) in self.config.left_over:
            return f"{text}add _delete_=True to that table, or override the whole table {key!r}"
        return ""


def _typed(place: str) -> bool:
    """Whether a value came from an option such as ``--set``, not from a file."""
    return place.startswith("--")


def _requirement_problems(config: Config) -> list[Problem]:
    """One problem for each requirement of ``config`` that does not hold or cannot be read."""
    wanted = config.tree.get(REQUIRES)
    if wanted is None:
        return []
    if not isinstance(wanted, list) or not all(isinstance(text, str) for text in wanted):
        return [
            config.problem(REQUIRES, f"must be a list like ['fluxvla-ur>=0.3'], got {wanted!r}")
        ]
    found = [(join_key(REQUIRES, i), _unmet(text)) for i, text in enumerate(wanted)]
    return [config.problem(key, what) for key, what in found if what]


def _unmet(text: str) -> str | None:
    from packaging.requirements import InvalidRequirement, Requirement

    try:
        requirement = Requirement(text)
    except InvalidRequirement as error:
        return f"{text!r} is not a requirement (PEP 508): {str(error).splitlines()[0]}"
    if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
        return None
    have = version(requirement.name)
    if have is None:
        command = f": pip install {requirement.name}"
        # Only names that we ship are put into a command; see plugins.first_party.
        return f"needs {text}, which is not installed" + (
            command if canonical(requirement.name) in FIRST_PARTY else ""
        )
    if not requirement.specifier.contains(have, prereleases=True):
        return f"needs {text}, but {requirement.name} {have} is installed"
    return None
