"""Low-rank adapters (LoRA, Hu et al. 2021) with peft, for every strategy.

peft puts its layers into the model in place, so that it stays the class that it is. What is
trained is saved under ``adapter/`` of a checkpoint in peft's own layout; the base stays where
``init_from`` says that it came from, and a hash in the checkpoint proves that it is still the same.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import permutations
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.training import VLA
from fluxvla_core.errors import ConfigError, nearest

if TYPE_CHECKING:
    from torch import Tensor, nn

    from fluxvla_core.checkpoints.checkpoint import Checkpoint

FOLDER = "adapter"
WEIGHTS = f"{FOLDER}/adapter_model.safetensors"
CONFIG = f"{FOLDER}/adapter_config.json"
_PREFIX = "base_model.model."
_OURS = re.compile(r"\.(?:modules_to_save|lora_\w+)\.default(?=\.|$)")
_PEFTS = ("base_layer", "lora_dropout")  # what peft puts into every layer that gets an adapter


def is_count(value: object, least: int) -> bool:
    """Whether an option is a whole number from ``least`` up."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def is_positive(value: object) -> bool:
    """Whether an option is a finite number above 0."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf


@dataclass(frozen=True)
class SavedAdapter:
    """The fields read from ``adapter_config.json``."""

    r: int
    target_modules: list[str] | str
    lora_alpha: float
    lora_dropout: float
    base_model_name_or_path: str | None
    modules_to_save: list[str] | None = None


@dataclass(frozen=True)
class LoraOptions:
    """The table ``lora`` of a train runner.

    Args:
        rank: of the added matrices.
        alpha: their sum is scaled by ``alpha / rank``; ``rank`` if not given.
        dropout: on their input.
        target_modules: linear and convolution layers that get one: ends of names, or one regular
            expression for whole names. By default those that the model names
            (``VLA.lora_defaults``), if it does.
        modules_to_save: modules, by the ends of their names, that are trained as a whole; the
            model's where ``target_modules`` are.
    """

    rank: int
    target_modules: tuple[str, ...] | str | None = None
    alpha: float | None = None
    dropout: float = 0.0
    modules_to_save: tuple[str, ...] = ()

    @classmethod
    def read(cls, table: Any, where: str | None, declared: bool = False) -> LoraOptions:
        """Take and check the table, or options that were made in Python.

        Args:
            declared: the model names layers itself, so that the table need not.

        Raises:
            ConfigError: unknown or missing keys, or invalid values.
        """
        table = vars(table) if isinstance(table, cls) else table
        known = [field.name for field in fields(cls)]
        if not isinstance(table, Mapping):
            raise ConfigError(f"lora must be a table, got {table!r}", where=where)
        for key in table:
            if key not in known:
                near = nearest(str(key), known)
                hint = f"did you mean {near!r}?" if near else f"it has {', '.join(known)}"
                raise ConfigError(f"lora has no {key!r}; {hint}", where=where)
        needed = ("rank",) if declared else ("rank", "target_modules")
        lacking = [key for key in needed if table.get(key) is None]
        if lacking:
            raise ConfigError(f"lora needs {' and '.join(map(repr, lacking))}", where=where)
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list | tuple) else v for k, v in table.items()
        }
        options = cls(**values)
        for key, fine, rule in (
            ("rank", is_count(options.rank, 1), "a whole number above 0"),
            ("alpha", options.alpha is None or is_positive(options.alpha), "a positive number"),
            (
                "dropout",
                options.dropout == 0 or (is_positive(options.dropout) and options.dropout < 1),
                "at least 0 and below 1",
            ),
            (
                "target_modules",
                options.target_modules is None
                or isinstance(options.target_modules, str)
                or _names(options.target_modules, least=1),
                "names, or one regular expression",
            ),
            ("modules_to_save", _names(options.modules_to_save), "names of modules"),
        ):
            if not fine:
                value = getattr(options, key)
                raise ConfigError(f"lora.{key} must be {rule}, got {value!r}", where=where)
        return options

    def for_model(self, model: nn.Module, where: str | None = None) -> LoraOptions:
        """With the layers that ``model`` names, where these options name none.

        A module in ``modules_to_save`` that has another one of this name inside becomes that one.

        Raises:
            ConfigError: the model names none either; or that other one is not all of the module.
        """
        options = self
        if self.target_modules is None:
            own = VLA.adapt(model).lora_defaults
            given = {k: v for k, v in vars(self).items() if v not in (None, ())}
            options = self.read({**own, **given}, where)
        saved = tuple(n for end in options.modules_to_save for n in _innermost(model, end, where))
        return replace(options, modules_to_save=saved)

    def for_peft(self, base: str | None = None) -> dict[str, Any]:
        """``adapter_config.json`` as peft reads it; ``base`` is where the base weights are from."""
        targets = self.target_modules
        return {
            "peft_type": "LORA",
            "r": self.rank,
            "lora_alpha": self.alpha if self.alpha is not None else self.rank,
            "lora_dropout": self.dropout,
            "target_modules": targets if isinstance(targets, str) else list(targets or ()),
            "modules_to_save": list(self.modules_to_save) or None,
            "base_model_name_or_path": base,
            "inference_mode": True,
        }

    @classmethod
    def of_checkpoint(cls, checkpoint: Checkpoint) -> LoraOptions | None:
        """The adapter that a checkpoint holds, None if it holds none."""
        if not checkpoint.has(CONFIG):
            return None
        saved = checkpoint.json(CONFIG, SavedAdapter)
        targets = saved["target_modules"]
        return cls(
            saved["r"],
            targets if isinstance(targets, str) else tuple(targets),
            saved["lora_alpha"],
            saved["lora_dropout"],
            tuple(saved.get("modules_to_save") or ()),
        )


def check_installed(where: str | None) -> None:
    """Refuse ``lora`` before anything is built where peft is missing.

    Raises:
        ConfigError: with the pip command.
    """
    import importlib.util

    if importlib.util.find_spec("peft") is None:
        raise ConfigError(
            "lora needs the package peft, which is not installed",
            where=where,
            next="pip install 'fluxvla-core[lora]'",
        )


def attach(
    model: nn.Module, options: LoraOptions, where: str | None = None, trained: bool = False
) -> LoraOptions:
    """Freeze ``model`` and put trainable adapters into it, drawn from torch's generator.

    Args:
        trained: the adapter is a checkpoint's: what its names hit in training they hit again.

    Returns:
        The options with the names that were used, see ``LoraOptions.for_model``.

    Raises:
        ConfigError: no module has such a name, one is of a kind that takes no adapter or shares
            its weights with another, or a name hits more than is meant.
    """
    from peft import LoraConfig, inject_adapter_in_model

    if not trained:
        options = options.for_model(model, where)
    _check_found(model, options, where)
    if not trained:
        _check_unambiguous(model, options.modules_to_save, where)
    settings = {k: v for k, v in options.for_peft().items() if k != "inference_mode"}
    tied = _tied(model)
    try:
        inject_adapter_in_model(LoraConfig(**settings), model)
    except (ValueError, TypeError) as error:
        # Only a module that cannot be trained as a whole is a TypeError to peft.
        key = "modules_to_save" if isinstance(error, TypeError) else "target_modules"
        raise ConfigError(
            f"lora.{key}: {str(error).splitlines()[0]}",
            where=where,
            next=f"the model has {_leaf_names(model)}",
        ) from error
    _check_untied(model, tied, where)
    return options


def _check_found(model: nn.Module, options: LoraOptions, where: str | None) -> None:
    targets = options.target_modules
    for key, ends in (
        ("target_modules", () if isinstance(targets, str) else targets or ()),
        ("modules_to_save", options.modules_to_save),
    ):
        for end in ends:
            if not any(_ends(name, end) for name, _ in model.named_modules()):
                raise ConfigError(
                    f"lora.{key}: no module's name ends in {end!r}",
                    where=where,
                    next=f"the model has {_leaf_names(model)}",
                )


def _innermost(model: nn.Module, end: str, where: str | None) -> list[str]:
    """``end``, or the whole names of the inner modules where modules of that name are nested.

    peft wraps both, and then trains only a copy that the forward pass does not use.
    """
    hit = {name: module for name, module in model.named_modules() if _ends(name, end)}
    nested = {n: inner for n in hit if (inner := [i for i in hit if _inside(i, n)])}
    for name, inner in nested.items():
        parts = [id(p) for i in inner for p in hit[i].parameters()]
        if {id(p) for p in hit[name].parameters()} - set(parts):
            raise ConfigError(
                f"lora.modules_to_save: {end!r} hits {name!r} and, inside it, {_listed(inner)}",
                where=where,
                cause="peft would train a copy of the inner one that is not used",
                next=f"name the parts of {name!r} that are to be trained",
            )
    return [name for name in hit if name not in nested] if nested else [end]


def _check_unambiguous(model: nn.Module, saved: Sequence[str], where: str | None) -> None:
    # peft takes any module whose name ends so, also in the middle of a part, and its own ones.
    names = [name for name, _ in model.named_modules(remove_duplicate=False)]
    for end in saved:
        others = [n for n in _also_hit(names, end) if not any(_ends(n, meant) for meant in saved)]
        if others:
            too = ", or name those too" if set(others) <= set(names) else ""
            raise ConfigError(
                f"lora.modules_to_save: {end!r} would also hit {_listed(others)}",
                where=where,
                cause="peft trains every module whose name ends in these letters",
                next=_longer_names(names, end) + too,
            )


def _also_hit(names: Iterable[str], end: str) -> list[str]:
    """Modules that peft takes for ``end`` though it is not a whole part of their names."""
    pefts = (f"peft's own {name}" for name in _PEFTS if name.endswith(end))
    return [*(n for n in names if n.endswith(end) and not _ends(n, end)), *pefts]


def _longer_names(names: Sequence[str], end: str) -> str:
    """What to write for ``end``: as much of each name as no other module's name ends in."""
    tails_found: list[str] = []
    for name in (n for n in names if _ends(n, end)):
        parts = name.split(".")
        tails = (".".join(parts[i:]) for i in reversed(range(len(parts))))
        tail = next((tail for tail in tails if not _also_hit(names, tail)), None)
        if tail is None:
            return f"{name!r} has no ending that is its own: rename it in the model"
        tails_found.append(repr(tail))
    return f"write {_listed(tails_found)} instead"


def _check_untied(model: nn.Module, tied: Iterable[tuple[str, str]], where: str | None) -> None:
    # Merging would change the other layer too, and what is trained as a whole is a copy, which is
    # no longer the other's when it is loaded. Looked at afterwards: only peft knows what it takes.
    from peft.tuners.tuners_utils import BaseTunerLayer
    from peft.utils import ModulesToSaveWrapper

    for name, module in model.named_modules():
        if not isinstance(module, BaseTunerLayer | ModulesToSaveWrapper):
            continue
        for one, other in tied:
            if _inside(one, name) and not _inside(other, name):
                whole = isinstance(module, ModulesToSaveWrapper)
                raise ConfigError(
                    f"lora.{'modules_to_save' if whole else 'target_modules'}: {name!r} has a "
                    f"weight that another module uses too: {one} and {other} are one",
                    where=where,
                    cause="the one cannot be trained, nor get an adapter, without the other",
                    next=f"leave {name!r} out, or give it a weight of its own in the model",
                )


def _tied(model: nn.Module) -> list[tuple[str, str]]:
    """Every two names that one parameter has, both ways round."""
    named: dict[int, list[str]] = {}
    for name, parameter in model.named_parameters(remove_duplicate=False):
        named.setdefault(id(parameter), []).append(name)
    return [pair for names in named.values() for pair in permutations(names, 2)]


def _inside(name: str, module: str) -> bool:
    return name.startswith(f"{module}.")


def _ends(name: str, end: str) -> bool:
    return f".{name}".endswith(f".{end}")


def adapter_names(model: nn.Module) -> dict[str, str]:
    """Names of what the adapters added to ``state_dict`` -> their names in peft's files."""
    names = [name for name in model.state_dict(keep_vars=True) if _OURS.search(name)]
    return {name: _PREFIX + _peft_name(name) for name in names}


def adapter_tensors(model: nn.Module, checkpoint: Checkpoint) -> dict[str, Tensor]:
    """The checkpoint's adapter under the names that ``model`` has for it.

    What ``model`` does not have keeps peft's name, so that it is noticed as unexpected.
    """
    if not checkpoint.has(WEIGHTS):
        return {}
    ours = {theirs: name for name, theirs in adapter_names(model).items()}
    return {ours.get(name, name): t for name, t in checkpoint.tensors(WEIGHTS).items()}


def merge_(model: nn.Module) -> None:
    """Merge the adapters into their layers, in place; without any nothing changes.

    The model then has the names, the classes and the size that it had before :func:`attach`.
    """
    from peft.tuners.tuners_utils import BaseTunerLayer
    from peft.utils import ModulesToSaveWrapper

    for name, module in list(model.named_modules()):
        if isinstance(module, ModulesToSaveWrapper):
            plain = module.modules_to_save["default"]
        elif isinstance(module, BaseTunerLayer):
            module.merge(safe_merge=True)
            plain = module.get_base_layer()
        else:
            continue
        parent, _, child = name.rpartition(".")
        setattr(model.get_submodule(parent), child, plain)
    model.__dict__.pop("peft_config", None)


def _peft_name(name: str) -> str:
    # modules_to_save.default.weight -> weight; lora_A.default.weight -> lora_A.weight
    return re.sub(
        r"\.default(?=\.|$)", "", name.replace(".modules_to_save.default", "", 1), count=1
    )


def _leaf_names(model: nn.Module) -> str:
    leaves = [n for n, m in model.named_modules() if n and not any(True for _ in m.children())]
    return _listed(leaves)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (" …" if len(names) > 8 else "")


def _names(value: Any, least: int = 0) -> bool:
    named = isinstance(value, tuple) and all(isinstance(item, str) for item in value)
    return named and len(value) >= least
