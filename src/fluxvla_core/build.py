"""From config tables to objects: ``build_<kind>_from_cfg`` for each registry.

A table is built one level deep: ``type`` names the class, the other keys are its arguments, and a
class builds its own children (a runner its operator, a dataset its transforms), as upstream
FluxVLA's classes do. So a class can supply defaults for its children.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fluxvla_core.config.resolve import INJECTED
from fluxvla_core.config.runtime_signature import option_names, type_mismatches
from fluxvla_core.config.signature import OPTIONS_KEYWORDS
from fluxvla_core.config.tree import join_key
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.errors import ConfigError, Problem
from fluxvla_core.plugins.registry import BY_NAME, Registry
from fluxvla_core.registries import ROWS, RegistryRow
from fluxvla_core.spec import EmbodimentSpec

T = TypeVar("T")


@dataclass(frozen=True)
class RunContext:
    """Command-line settings and paths of a run.

    Args:
        config: the whole resolved config tree.
        section: the section that runs: ``runner``, ``eval``, ``inference``, …
        work_dir: the folder for all files of the run.
        resume: ``auto``, a checkpoint's path, or None.
        origins: dotted config key -> ``file:line``.
        config_file: the file that was named on the command line.
        task: ``--task``: an id from the config, or its instruction.
        task_file: ``--tasks``: a file with one task a line.
        free_task: ``--free-task``: other instructions are allowed, too.
        nproc: ``--nproc``: the number of processes, by default 1 for a training and None otherwise.
            It overrides ``workers``; a runner that neither trains nor has ``workers`` refuses it.
        reporter: receives progress and messages.
    """

    config: Mapping[str, Any] = field(default_factory=dict)
    section: str = ""
    work_dir: Path = Path("work_dirs/run")
    resume: str | None = None
    origins: Mapping[str, str] = field(default_factory=dict)
    config_file: str | None = None
    task: str | None = None
    task_file: str | None = None
    free_task: bool = False
    nproc: int | None = None
    reporter: Reporter = field(default_factory=SilentReporter)

    def where(self, key: str) -> str | None:
        """``file:line: key`` of a config key, for messages."""
        place = self.origins.get(key)
        return f"{place}: {key}" if place else None

    def error(self, key: str, problem: str) -> ConfigError:
        """An error about ``key`` of the section that runs."""
        return ConfigError(f"{key} {problem}", where=self.where(f"{self.section}.{key}"))


def build_from_cfg(
    cfg: Any, registry: Registry, context: RunContext | None = None, **defaults: Any
) -> Any:
    """Build the object that the table ``cfg`` describes; an object is returned as it is.

    Args:
        cfg: a mapping with ``type``, or something already built.
        context: passed to constructors that name ``context``, its config to those that name
            ``cfg`` (in the signature or, through ``**kwargs``, in a base class).
        defaults: arguments used where the table does not set them.

    Raises:
        ConfigError: no ``type``, an injected parameter is set, the arguments do not fit, or the
            constructor fails at values of other types than it is annotated with.
        PluginError: the class cannot be loaded.
    """
    if not isinstance(cfg, Mapping):
        return cfg
    arguments = {**defaults, **cfg}
    name = arguments.pop("type", None)
    cls = class_of(name, registry)
    taken = parameters(cls)
    for key in INJECTED:
        if key in cfg and context is not None:
            raise ConfigError(
                f"{cls.__name__}: {key!r} is filled in when the run starts and cannot be set"
            )
    if context is not None:
        if "context" in taken:
            arguments.setdefault("context", context)
        if "cfg" in taken:
            arguments.setdefault("cfg", context.config)
    try:
        inspect.signature(cls).bind(**arguments)
    except TypeError as error:
        raise ConfigError(
            f"{cls.__name__}: {error}",
            where=_where(cfg, context),
            next=f"fluxvla plugins show {name}",
        ) from error
    try:
        return cls(**arguments)
    except (AttributeError, TypeError, ValueError) as error:
        explained = _explained(cls, cfg, context)
        if explained is None:
            raise
        # An annotation may be wrong: what really happened is reported too.
        explained.cause = f"the constructor raised {type(error).__name__}: {error}"
        raise explained from error


def bind_options(kind: type[T], given: Mapping[str, Any], name: str, context: RunContext) -> T:
    """The settings of a class whose constructor takes ``**options``: its dataclass ``Options``.

    Args:
        kind: that dataclass.
        given: the constructor's keywords.
        name: the class's.

    Raises:
        ConfigError: a key is unknown, or one that is required is missing.
    """
    try:
        bound = inspect.signature(kind).bind(**given)
    except TypeError as error:
        raise ConfigError(
            f"{name}: {error}",
            where=context.where(context.section),
            next=f"fluxvla plugins show {name}",
        ) from error
    return kind(*bound.args, **bound.kwargs)


def takes(cfg: Any, registry: Registry, name: str) -> bool:
    """Whether the class of the table ``cfg`` has a parameter called ``name``; an object has none.

    Raises:
        ConfigError: no ``type``.
        PluginError: the class cannot be loaded.
    """
    return isinstance(cfg, Mapping) and name in parameters(class_of(cfg.get("type"), registry))


def parameters(cls: type) -> set[str]:
    """Names that a constructor takes, following ``**kwargs`` into its base classes and Options."""
    names: set[str] = set()
    for found in constructors(cls):
        names |= {n for n, p in found.items() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
        kwargs = [n for n, p in found.items() if p.kind is p.VAR_KEYWORD]
        if kwargs == [OPTIONS_KEYWORDS]:
            names |= option_names(cls)
    return names - {"self"}


def constructors(cls: type) -> Iterator[Mapping[str, inspect.Parameter]]:
    """Parameters of the constructors that ``cls(**kwargs)`` reaches, the class's own first."""
    for base in inspect.getmro(cls):
        init = base.__dict__.get("__init__")
        if init is None or base is object:
            continue
        found = inspect.signature(init).parameters
        yield found
        if not any(p.kind is p.VAR_KEYWORD for p in found.values()):
            return


def _explained(cls: type, cfg: Mapping[str, Any], context: RunContext | None) -> ConfigError | None:
    """The error for values that do not fit the annotations of a constructor, if there are any."""
    wrong = type_mismatches(cls, {key: value for key, value in cfg.items() if key != "type"})
    if not wrong:
        return None
    table = _key_of(cfg, context.config) if context is not None else None
    problems = [
        Problem(
            context.origins.get(join_key(table, one.name), "") if context and table else "",
            join_key(table or "", one.name),
            f"{cls.__name__}: {one}",
        )
        for one in wrong
    ]
    return ConfigError.from_problems(tuple(problems), next=f"fluxvla plugins show {cls.__name__}")


def robot_of(config: Mapping[str, Any]) -> EmbodimentSpec | None:
    """The robot that a config's policy acts on; None where the config does not say.

    It is that of ``inference.operator``, or what the ``robot_spec()`` of the runner of the section
    ``inference`` or ``eval`` returns, which a runner of one simulated robot has.

    Raises:
        ConfigError, PluginError: what is named cannot be built here.
    """
    sections = [config.get(name) for name in ("inference", "eval")]
    tables = [section for section in sections if isinstance(section, Mapping)]
    if tables and tables[0] is sections[0] and tables[0].get("operator") is not None:
        operator = Operator.adapt(build_from_cfg(tables[0]["operator"], BY_NAME["operators"]))
        try:
            return operator.embodiment
        finally:
            operator.close()
    for table in tables:
        described = getattr(class_of(table.get("type"), BY_NAME["runners"]), "robot_spec", None)
        if described is not None:
            robot: EmbodimentSpec = described()
            return robot
    return None


def class_of(name: Any, registry: Registry) -> type:
    """The class that the ``type`` of a table of ``registry`` names.

    Raises:
        ConfigError: it is neither a name nor a class.
        PluginError: the class cannot be loaded.
    """
    if inspect.isclass(name):
        return name
    if isinstance(name, str):
        cls: type = registry.get(name)
        return cls
    raise ConfigError(
        f"a table for fluxvla.{registry.name} needs type = '<class name>', got {name!r}"
    )


def _where(cfg: Mapping[str, Any], context: RunContext | None) -> str | None:
    key = _key_of(cfg, context.config) if context is not None else None
    return context.where(key) if context is not None and key else None


def _key_of(cfg: Any, tree: Any, key: str = "") -> str | None:
    """The dotted key of the table ``cfg`` (by identity) in ``tree``."""
    items = tree.items() if isinstance(tree, Mapping) else enumerate(tree)
    for name, value in items:
        inner = join_key(key, name)
        if value is cfg:
            return inner
        if isinstance(value, Mapping | list | tuple):
            found = _key_of(cfg, value, inner)
            if found:
                return found
    return None


def _builder(row: RegistryRow) -> Callable[..., Any]:
    def build(cfg: Any, context: RunContext | None = None, **defaults: Any) -> Any:
        return build_from_cfg(cfg, BY_NAME[row.name], context, **defaults)

    build.__name__ = build.__qualname__ = str(row.builder)
    build.__doc__ = f"Build the object of a table of {row.group}; see :func:`build_from_cfg`."
    return build


if TYPE_CHECKING:  # the names that the table makes; a test compares them
    build_runner_from_cfg: Callable[..., Any]
    build_operator_from_cfg: Callable[..., Any]
    build_vla_from_cfg: Callable[..., Any]
    build_vision_backbone_from_cfg: Callable[..., Any]
    build_llm_backbone_from_cfg: Callable[..., Any]
    build_vlm_backbone_from_cfg: Callable[..., Any]
    build_projector_from_cfg: Callable[..., Any]
    build_head_from_cfg: Callable[..., Any]
    build_dataset_from_cfg: Callable[..., Any]
    build_transform_from_cfg: Callable[..., Any]
    build_collator_from_cfg: Callable[..., Any]
    build_tokenizer_from_cfg: Callable[..., Any]
    build_processor_from_cfg: Callable[..., Any]
    build_metric_from_cfg: Callable[..., Any]
    build_optimizer_from_cfg: Callable[..., Any]
    build_action_filter_from_cfg: Callable[..., Any]
    build_environment_from_cfg: Callable[..., Any]
    build_policy_from_cfg: Callable[..., Any]
else:
    globals().update({row.builder: _builder(row) for row in ROWS if row.builder})
