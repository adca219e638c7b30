"""What constructors of classes take that this process registered."""

from __future__ import annotations

import ast
import dataclasses
import sys
from typing import Any

import pytest

from fluxvla_core.build import parameters
from fluxvla_core.config.runtime_signature import inspect_signature, type_mismatches
from fluxvla_core.config.signature import Signature


def required(signature: Signature | None) -> dict[str, bool]:
    assert signature is not None
    return {p.name: p.required for p in signature.parameters}


class Base:
    """Registered here.

    Second line.
    """

    api = "1.0"

    def __init__(self, cfg: dict[str, int], rate: int = 30) -> None: ...

    def run_setup(self, n_train_examples: int) -> None: ...


class Sub(Base):
    def __init__(self, mine: int, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("cfg", {})
        super().__init__(*args, **kwargs)


class Swallows(Base):
    def __init__(self, mine: int, **kwargs: Any) -> None:
        self.kwargs = kwargs


@dataclasses.dataclass
class Data:
    a: int
    b: int = 2


def test_a_class_of_this_process() -> None:
    signature = inspect_signature(Sub)
    assert required(signature) == {"mine": True, "cfg": False, "rate": False}
    assert not signature.open
    assert signature.trains
    assert signature.api == "1.0"
    assert signature.place.endswith(f"test_signature_in_process.py:{_line('class Sub')}")
    assert inspect_signature(Base).doc == "Registered here."
    assert inspect_signature(Swallows).open
    assert required(inspect_signature(Data)) == {"a": True, "b": False}
    assert required(inspect_signature(type("Made", (), {}))) == {}
    assert inspect_signature(type("Made", (ValueError,), {})).open


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings.

    Args:
        rate: commands a second
    """

    must: int
    rate: float = 30.0
    steps: int = 1
    """Steps."""
    left_out: int = dataclasses.field(default=0, init=False)


class Configured:
    Options = Settings

    def __init__(self, cfg: dict[str, int], **options: Any) -> None:
        self.options = self.Options(**options)


def test_options_of_a_class_of_this_process() -> None:
    signature = inspect_signature(Configured)
    assert required(signature) == {"cfg": True, "must": True, "rate": False, "steps": False}
    assert not signature.open
    assert signature.meanings == {"rate": "commands a second", "steps": "Steps."}
    assert signature.parameters[2].text == ": 'float' = 30.0"
    place = signature.parameters[1].place
    assert place.endswith(f"test_signature_in_process.py:{_line('class Settings') - 1}")
    assert parameters(Configured) == {"cfg", "must", "rate", "steps"}
    assert [str(one) for one in type_mismatches(Configured, {"rate": "fast"})] == [
        "'rate' must be float, got 'fast'"
    ]


def test_a_class_without_readable_source_is_taken_to_pass_its_kwargs_on() -> None:
    space: dict[str, Any] = {"Base": Base}
    exec(
        "class Cell(Base):\n  def __init__(self, x, **kw): super().__init__(**kw)\n",
        space,
    )
    signature = inspect_signature(space["Cell"])
    assert required(signature) == {"x": True, "cfg": True, "rate": False}


def test_a_torch_module_takes_no_parameters_of_its_own() -> None:
    nn = pytest.importorskip("torch.nn")

    class Net(nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self, width: int, **kwargs: Any) -> None:
            super().__init__(**kwargs)

    signature = inspect_signature(Net)
    assert required(signature) == {"width": True}
    assert not signature.open


def test_what_is_no_class() -> None:
    with pytest.raises(TypeError, match="is not a class"):
        inspect_signature(print)


def _line(text: str) -> int:
    import inspect

    source = inspect.getsource(sys.modules[__name__])
    node = next(
        n
        for n in ast.parse(source).body
        if isinstance(n, ast.ClassDef) and text == f"class {n.name}"
    )
    return node.lineno
