"""The reference of the contracts, from their source: what each method is, and who calls it when.

griffe reads the modules; nothing of FluxVLA is imported but its table of registries. ``calls.toml``
says who calls what.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import griffe
import tomli

from fluxvla_core.registries import ROWS
from tools.docs.pages import escaped

CALLS = Path(__file__).with_name("calls.toml")
_CONTRACTS = "contracts/{}.py"
_ROLE = re.compile(r":\w+:`~?([^`]+)`")
_SELF = ("self", "cls")
# What is documented for people who read it need not be in a form that griffe takes for complete.
logging.getLogger("griffe").setLevel(logging.ERROR)


@dataclass(frozen=True)
class Page:
    """One page of the reference.

    Args:
        name: of its file, without ``.md``.
        title: its heading.
        about: the text below it.
        classes: module below ``fluxvla_core`` -> classes of it; contracts, or data classes.
        only: class -> the methods that are shown of it; all public ones by default.
    """

    name: str
    title: str
    about: str
    classes: Mapping[str, tuple[str, ...]]
    only: Mapping[str, tuple[str, ...]] = ()  # type: ignore[assignment]


_BASE_TRAIN = (
    "run_setup",
    "run",
    "_build_vla",
    "_build_lr_scheduler",
    "_run_epoch_based",
    "_run_step_based",
)
_STRATEGY = (
    "_wrap_model",
    "unwrap_model",
    "_build_optimizer",
    "_training_step",
    "sync_gradients",
    "backward",
    "optimizer_step",
    "clip_grad_norm",
    "before_first_step",
    "save_checkpoint",
    "resume",
    "_load_model_state",
    "_load_optimizer_state",
    "model_tensors",
    "optimizer_tensors",
    "load_optimizer_tensors",
)
_INFERENCE = (
    "run_setup",
    "run",
    "_run_episode",
    "get_ros_observation",
    "update_observation_window",
    "_execute_actions",
)

PAGES = (
    Page(
        "operator",
        "Operators and action filters",
        "What runs at the rate of the robot. [Your robot](../tutorials/your-robot.md) builds one.",
        {_CONTRACTS.format("robot"): ("Operator", "ActionFilter", "Clock")},
    ),
    Page(
        "policy",
        "Policies",
        "Observation in, chunk of actions out.",
        {_CONTRACTS.format("policy"): ("Actor", "Policy", "Continuation")},
    ),
    Page(
        "environment",
        "Environments",
        "Simulators in which policies are evaluated and data is collected. "
        "[Your environment](../tutorials/your-environment.md) builds one.",
        {
            _CONTRACTS.format("environment"): (
                "Environment",
                "EnvironmentSpec",
                "TaskSpec",
                "Step",
            )
        },
    ),
    Page(
        "training",
        "Models, data and training",
        "What a training is made of. [Your model](../tutorials/your-model.md) builds one.",
        {
            _CONTRACTS.format("training"): (
                "VLA",
                "PartWeights",
                "Dataset",
                "InferenceDataset",
                "Transform",
                "RandomTransform",
                "Collator",
                "Tokenizer",
                "Metric",
                "Optimizer",
            )
        },
    ),
    Page(
        "runner",
        "Runners, hooks and commands",
        "What the command line runs, and what watches it.",
        {_CONTRACTS.format("runner"): ("Runner", "TrainRunner", "Hook", "Command")},
    ),
    Page(
        "base-runners",
        "Base classes of runners",
        "What a runner inherits, and may override. [Your training strategy]"
        "(../tutorials/your-training-strategy.md) overrides some of it. Names and arguments are "
        "those of the specification; [Coming from upstream](../porting/upstream.md) compares.",
        {
            "training/base_runner.py": ("BaseTrainRunner",),
            "training/strategy.py": ("Strategy",),
            "robot/runner.py": ("BaseInferenceRunner",),
        },
        {
            "BaseTrainRunner": _BASE_TRAIN,
            "Strategy": _STRATEGY,
            "BaseInferenceRunner": _INFERENCE,
        },
    ),
    Page(
        "checkpoint-format",
        "Checkpoint formats",
        "What reads and writes another project's checkpoints.",
        {_CONTRACTS.format("checkpoint_format"): ("CheckpointFormat", "ForeignCheckpoint")},
    ),
    Page(
        "records",
        "Frames, observations, embodiments",
        "The data that the contracts exchange.",
        {
            _CONTRACTS.format("frame"): ("Frame", "Observation"),
            "spec.py": ("EmbodimentSpec", "Joint", "Camera"),
        },
    ),
)
"""Every page; ``test_reference.py`` compares their contracts with those that there are."""


def calls() -> Mapping[str, Mapping[str, str]]:
    """Contract -> method or attribute -> who calls it, and when."""
    found: Mapping[str, Mapping[str, str]] = tomli.loads(CALLS.read_text(encoding="utf-8"))
    return found


def render(page: Page, core: Path) -> str:
    """The text of ``page``.

    Args:
        core: the folder of ``fluxvla_core``.
    """
    parts = [f"# {page.title}", page.about]
    for module, names in page.classes.items():
        read = griffe.visit(
            f"fluxvla_core.{module.removesuffix('.py').replace('/', '.')}",
            filepath=core / module,
            code=(core / module).read_text(encoding="utf-8"),
            docstring_parser=griffe.Parser.google,
        )
        for name in names:
            parts += _class(read.classes[name], dict(page.only).get(name))
    return "\n\n".join(part for part in parts if part) + "\n"


def _class(cls: griffe.Class, only: tuple[str, ...] | None) -> Iterator[str]:
    yield f"## {cls.name} {{ #{cls.name} }}"
    groups = [row.group for row in ROWS if (row.contract or "").endswith(f":{cls.name}")]
    yield "\n".join(
        f"Entry-point group `{group}`, API version {row.api}."
        for group in groups
        for row in ROWS
        if row.group == group
    )
    yield _docstring(cls)
    who = calls().get(cls.name, {})
    wanted = only or tuple(who)
    members = [
        (name, member)
        for name, member in _members(cls).items()
        if (name in wanted if wanted else _shown(name, member))
    ]
    if who:
        yield _table(cls, members, who)
    for name, member in members:
        yield f"### `{name}` {{ #{_anchor(cls, name)} }}"
        yield f"```python\n{_signature(name, member)}\n```"
        if name in who:
            verb = "Called" if member.is_function and not _read(member) else "Read"
            yield f"**{_status(cls, member)}.** {verb} by: {who[name]}."
        yield _docstring(member)


def _members(cls: griffe.Class) -> dict[str, griffe.Object | griffe.Alias]:
    """Its members, and those of private base classes of its module, which have no place."""
    found: dict[str, griffe.Object | griffe.Alias] = {}
    for base in map(str, cls.bases):
        if base.startswith("_") and base in cls.module.classes:
            found |= _members(cls.module.classes[base])
    return {**found, **cls.members}


def _shown(name: str, member: griffe.Object | griffe.Alias) -> bool:
    return not name.startswith("_") and (member.is_function or member.docstring is not None)


def _table(
    cls: griffe.Class,
    members: list[tuple[str, griffe.Object | griffe.Alias]],
    who: Mapping[str, str],
) -> str:
    lines = ["| | called or read by, and when |", "|---|---|"]
    for name, member in members:
        called = "()" if member.is_function and not _read(member) else ""
        link = f"[`{name}{called}`](#{_anchor(cls, name)})"
        required = "*required*: " if _status(cls, member) == "Required" else ""
        lines.append(f"| {link} | {required}{who[name]} |")
    return "\n".join(lines)


def _anchor(cls: griffe.Class, name: str) -> str:
    return f"{cls.name}.{name.strip('_')}"  # Markdown would make bold text of __call__


def _decorators(member: griffe.Object | griffe.Alias) -> set[str]:
    return {str(d.value) for d in member.decorators} if member.is_function else set()


def _read(member: griffe.Object | griffe.Alias) -> bool:
    """Whether it is an attribute that is read, though a function says its default."""
    return bool(_decorators(member) & {"attribute", "required", "property"})


def _status(cls: griffe.Class, member: griffe.Object | griffe.Alias) -> str:
    if _decorators(member) & {"abstractmethod", "required"}:
        return "Required"
    # It has a type and no default: only the command line's ``help`` is so.
    return "Required" if member.is_attribute and member.value is None else "Optional"


def _signature(name: str, member: griffe.Object | griffe.Alias) -> str:
    """As Python would have it, without ``self``; of an attribute its type and default."""
    if not member.is_function:
        note = f": {member.annotation}" if member.annotation else ""
        return f"{name}{note}" + (f" = {member.value}" if member.value is not None else "")
    returns = str(member.returns) if member.returns else "None"
    if _read(member):
        return f"{name}: {returns}"
    return f"{name}({_parameters(member)}) -> {returns}"


def _parameters(function: griffe.Object | griffe.Alias) -> str:
    shown, before = [], ""
    for one in function.parameters:
        kind = one.kind.name if one.kind else ""
        if one.name in _SELF:
            continue
        if kind == "keyword_only" and before not in ("keyword_only", "var_positional"):
            shown.append("*")
        stars = {"var_positional": "*", "var_keyword": "**"}.get(kind, "")
        note = f": {one.annotation}" if one.annotation else ""
        given = f" = {one.default}" if one.default is not None and not stars else ""
        shown.append(f"{stars}{one.name}{note}{given}")
        before = kind
    line = ", ".join(shown)
    return line if len(line) < 60 else "\n    " + ",\n    ".join(shown) + ",\n"


def _docstring(member: griffe.Object | griffe.Alias) -> str:
    if member.docstring is None:
        return ""
    return "\n\n".join(_section(section) for section in member.docstring.parsed)


def _section(section: griffe.DocstringSection) -> str:
    """A part of a docstring as Markdown."""
    kind = section.kind.value
    if kind == "text":
        return as_markdown(section.value)
    if kind in ("parameters", "attributes"):
        return "\n".join(f"- `{one.name}`: {as_markdown(one.description)}" for one in section.value)
    title = {"raises": "Raises", "returns": "Returns", "yields": "Yields"}.get(kind)
    if title is None:
        return as_markdown(str(section.value))
    lines = [
        f"- `{str(one.annotation).strip('()')}`: {as_markdown(one.description)}"
        if one.annotation
        else f"- {as_markdown(one.description)}"
        for one in section.value
    ]
    return f"{title}:\n\n" + "\n".join(lines)


def as_markdown(text: str) -> str:
    """A piece of a docstring without the roles of Sphinx."""
    return escaped(_ROLE.sub(r"`\1`", text).strip())
