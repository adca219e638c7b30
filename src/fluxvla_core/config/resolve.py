"""Find the class behind a ``type`` in a config, statically: nothing is imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fluxvla_core.config.parameters import Parameter
from fluxvla_core.config.signature import Signature, read_signature
from fluxvla_core.config.source import Opaque, lacks, syntax_error
from fluxvla_core.config.source import find as find_source
from fluxvla_core.errors import (
    AmbiguousPlugin,
    IncompatiblePlugin,
    LoadFailed,
    MissingPlugin,
    PluginError,
    nearest,
)
from fluxvla_core.plugins import first_party
from fluxvla_core.plugins._metadata import Plugin
from fluxvla_core.plugins.load import LIST, core_provides, find, locate, not_read, unmet, upgrade
from fluxvla_core.plugins.registry import BY_NAME
from fluxvla_core.registries import PREFIX, check_api

SECTIONS = ("runner", "inference", "eval")

SLOTS: Mapping[str, str] = {
    **dict.fromkeys(SECTIONS, "runners"),
    "model": "vlas",
    "inference_model": "vlas",
    "dataset": "datasets",
    "datasets": "datasets",
    "transforms": "transforms",
    "collator": "collators",
    "metric": "metrics",
    "optimizer": "optimizers",
    "operator": "operators",
    "vision_backbone": "vision_backbones",
    "llm_backbone": "llm_backbones",
    "vlm_backbone": "vlm_backbones",
    "projector": "projectors",
    "vla_head": "heads",
    "tokenizer": "tokenizers",
    "action_filters": "action_filters",
    "hooks": "hooks",
    "environment": "environments",
    "policy": "policies",
}
"""Key -> the registry that a table under it is built from."""

INJECTED = ("cfg", "context")
"""Constructor parameters that are filled in when the run starts; a config may not set them."""

LOADERS = ("train_dataloader", "val_dataloader")
LOADER_KEYS = (
    "per_device_batch_size",
    "per_device_num_workers",
    "shuffle_episodes",
    "dataset",
)
"""Keys of ``train_dataloader`` that the core's train runners read."""

SEARCHED = tuple(name for name in BY_NAME if name != "commands")


@dataclass(frozen=True)
class Found:
    """The class behind a ``type``; ``signature`` is None where no source could be read."""

    registry: str
    name: str
    origin: str
    signature: Signature | None

    @property
    def title(self) -> str:
        return self.signature.name if self.signature else self.name


def resolve(name: str, registry: str | None = None) -> Found:
    """The class called ``name`` (or ``distribution:name``) in ``registry``, or in any.

    Raises:
        MissingPlugin: nothing provides it; with a did-you-mean or the pip command.
        AmbiguousPlugin: several distributions, or several registries, do.
        IncompatiblePlugin: written for another core or contract.
        LoadFailed: its module or class is not where the entry point says.
    """
    if registry is None:
        registry = _only_registry(name)
    elif name not in BY_NAME[registry]:
        others = [r for r in SEARCHED if name in BY_NAME[r]]
        if others:
            raise MissingPlugin(
                f"{name!r} is one of {PREFIX}{others[0]}, and this key takes {PREFIX}{registry}"
            )
    here = BY_NAME[registry].registered(name)
    if here is not None:
        from fluxvla_core.config.runtime_signature import inspect_signature

        signature = inspect_signature(here)
        return Found(registry, name, "registered in this process", signature)
    plugin = find(PREFIX + registry, name, tuple(BY_NAME[registry]))
    return installed(plugin)


def table_signature(path: Sequence[str], table: Mapping[str, Any]) -> Signature | None:
    """The signature for the table at ``path`` of a config; None where that is not known."""
    if len(path) == 1 and path[0] in LOADERS:
        takes = tuple(Parameter(name, False, "") for name in LOADER_KEYS)
        return Signature(path[0], "", takes, open=True)
    kind = table.get("type")
    if not isinstance(kind, str):
        return None
    slots = [part for part in path if not part.isdigit()]
    try:
        return resolve(kind, SLOTS.get(slots[-1]) if slots else None).signature
    except PluginError:  # the check of the whole config says what is wrong with it
        return None


def installed(plugin: Plugin) -> Found:
    """The class of one entry point; raises as :func:`resolve` does."""
    registry = plugin.group.removeprefix(PREFIX)
    why = unmet(plugin)
    if why:
        raise IncompatiblePlugin(why, next=upgrade(plugin))
    signature = read_signature(plugin)
    if signature is None:
        if locate(plugin.module) is None:
            raise LoadFailed(
                f"{plugin.origin} provides {plugin.name!r} but its module {plugin.module!r} is "
                f"missing (a stale or orphaned install): reinstall {plugin.dist}"
            )
        source = find_source(plugin.module, plugin.attribute)
        broken = syntax_error(source.name) if isinstance(source, Opaque) else None
        if broken:
            raise LoadFailed(
                f"{plugin.origin} provides {plugin.name!r} but its source has a syntax error: "
                f"{broken}"
            )
        if lacks(plugin.module, plugin.attribute):
            raise LoadFailed(
                f"{plugin.origin}: entry point {plugin.name} = {plugin.value!r} names an object "
                "that does not exist"
            )
    elif signature.api is not None:
        check_api(registry, signature.name, signature.api, plugin.origin)
    return Found(registry, plugin.name, plugin.origin, signature)


def _only_registry(name: str) -> str:
    """The one registry that has ``name``, or the one in which the core has it."""
    hits = [r for r in SEARCHED if name in BY_NAME[r]]
    hits = [r for r in hits if core_provides(PREFIX + r, name)] or hits
    if len(hits) == 1:
        return hits[0]
    if hits:
        raise AmbiguousPlugin(
            f"{name!r} is in {', '.join(PREFIX + r for r in hits)}, and the key does not say which",
            next="write '<distribution>:<name>', or put it under a key that says it",
        )
    short = name.rpartition(":")[2]
    unread = not_read(short)
    if unread:
        raise MissingPlugin(f"no plugin named {name!r} in any registry; {unread}", next=LIST)
    for registry in SEARCHED:
        owner = first_party.owner(registry, short)
        if owner:
            raise MissingPlugin(
                f"no plugin named {name!r}; {owner} provides it and is not installed: "
                f"pip install {owner}",
                next=LIST,
            )
    names = {n for r in SEARCHED for n in (*BY_NAME[r], *first_party.names(r))}
    near = nearest(short, sorted(names))
    hint = f"; did you mean {near!r}?" if near else ""
    raise MissingPlugin(f"no plugin named {name!r} in any registry{hint}", next=LIST)
