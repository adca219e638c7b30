"""What constructors take, read from source, across modules and base classes."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

from fluxvla_core.config.signature import Signature, read_signature
from fluxvla_core.config.source import argument_texts
from fluxvla_core.plugins._metadata import Plugin
from tests.conftest import Install

Read = Callable[..., Signature | None]


@pytest.fixture
def read(install: Install) -> Read:
    """``read("Class", a="module text", …)``: the signature of ``a:Class``; modules are toy_<x>."""

    def run(name: str, **modules: str) -> Signature | None:
        install("fluxvla-toy", files={f"toy_{m}.py": text for m, text in modules.items()})
        module = f"toy_{next(iter(modules))}"
        return read_signature(
            Plugin("fluxvla.runners", name, f"{module}:{name}", "fluxvla-toy", "1")
        )

    return run


def required(signature: Signature | None) -> dict[str, bool]:
    assert signature is not None
    return {p.name: p.required for p in signature.parameters}


def test_names_defaults_places_and_documentation(read: Read) -> None:
    signature = read(
        "R",
        a='''class R:
    """Runs.

    More.
    """

    api = "1.0"

    def __init__(self, lr: float, epochs: int = 3, *, seed=None, key):
        pass

    def run_setup(self, n_train_examples): ...
''',
    )
    assert required(signature) == {"lr": True, "epochs": False, "seed": False, "key": True}
    assert signature is not None
    assert signature.place == "toy_a.py:1"
    assert signature.parameters[1].place == "toy_a.py:9"
    assert [p.text for p in signature.parameters] == [": float", ": int = 3", " = None", ""]
    assert (signature.doc, signature.api, signature.open) == ("Runs.", "1.0", False)
    assert signature.trains
    assert not [m for m in sys.modules if m.startswith("toy_")]


def test_a_class_without_a_constructor_takes_nothing(read: Read) -> None:
    assert required(read("R", a="class R: pass\n")) == {}


def test_kwargs_are_followed_into_bases_of_other_modules(read: Read) -> None:
    signature = read(
        "R",
        a="""
import toy_b as b
class R(b.Middle):
    def __init__(self, mine=1, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.mine = mine
""",
        b="""
from toy_c import Base as _Base
Middle0 = _Base
class Middle(Middle0):
    api = "1.0"
    def __init__(self, rate=30, **kwargs):
        super().__init__("first", rate=rate, fixed=2, **kwargs)
""",
        c="""
class Base:
    def __init__(self, cfg, rate, fixed, learning_rate, epochs=1): ...
    def run_setup(self): ...
""",
    )
    assert required(signature) == {
        "mine": False,
        "rate": False,
        "learning_rate": True,
        "epochs": False,
    }
    assert signature is not None
    assert signature.api == "1.0"
    assert not signature.open
    assert not signature.trains
    assert next(p for p in signature.parameters if p.name == "epochs").place == "toy_c.py:3"


def test_kwargs_that_are_filled_popped_or_swallowed(read: Read) -> None:
    base = "class Base:\n    def __init__(self, camera_names, operator, prepare): ...\n"
    signature = read(
        "R",
        a="""
from toy_b import Base
class R(Base):
    def __init__(self, **kwargs):
        if kwargs.get('camera_names') is None:
            kwargs['camera_names'] = ['front']
        kwargs.setdefault('operator', {})
        self.x = kwargs.pop('x', 1)
        self.y = kwargs.pop('y')
        Base.__init__(self, **kwargs)
class Open(Base):
    def __init__(self, seed, **kwargs):
        self.rest = kwargs
        other.__init__(1)
""",
        b=base,
    )
    assert required(signature) == {
        "x": False,
        "y": True,
        "camera_names": False,
        "operator": False,
        "prepare": True,
    }
    source = Plugin("fluxvla.runners", "Open", "toy_a:Open", "fluxvla-toy", "1")
    swallowing = read_signature(source)
    assert swallowing is not None
    assert swallowing.open
    assert required(swallowing) == {"seed": True}


def test_mixins_follow_the_method_resolution_order(read: Read) -> None:
    signature = read(
        "R",
        a="""
from typing import Generic, TypeVar, Protocol
from abc import ABC
import torch.nn as nn
T = TypeVar('T')
class Root(ABC):
    def __init__(self, root): ...
class Left(Root, Generic[T]):
    def __init__(self, left, **kw): super().__init__(**kw)
class Right(Root, Protocol):
    def __init__(self, right, **kw): super().__init__(**kw)
class R(Left[int], Right): ...
class Net(nn.Module):
    def __init__(self, width, **kw): super().__init__(**kw)
""",
    )
    assert list(required(signature)) == ["left", "right", "root"]
    net = read_signature(Plugin("fluxvla.vlas", "Net", "toy_a:Net", "fluxvla-toy", "1"))
    assert required(net) == {"width": True}
    assert net is not None
    assert not net.open


def test_a_base_that_cannot_be_read_leaves_the_signature_open(read: Read) -> None:
    signature = read(
        "R",
        a="""
from nowhere_installed import Base
class R(Base):
    def __init__(self, x, **kwargs): super().__init__(**kwargs)
class Bare(Base): ...
class Own(Base):
    def __init__(self, x): super().__init__()
class Made(make_base()):
    pass
""",
    )
    assert signature is not None
    assert signature.open
    for name, is_open in {"Bare": True, "Own": False, "Made": True}.items():
        found = read_signature(Plugin("g", name, f"toy_a:{name}", "fluxvla-toy", "1"))
        assert found is not None
        assert found.open is is_open, name


def test_dataclasses(read: Read) -> None:
    signature = read(
        "T",
        a="""
import dataclasses
from dataclasses import dataclass, field, KW_ONLY
from typing import ClassVar
@dataclasses.dataclass
class Base:
    height: int
    needs_rng: ClassVar[bool] = True
@dataclass(frozen=True)
class T(Base):
    width: int = 3
    _: KW_ONLY
    keys: list = field(default_factory=list)
    cache: dict = field(init=False)
    must: str = field(repr=False)
    def method(self): ...
    plain = 3
""",
    )
    assert required(signature) == {"height": True, "width": False, "keys": False, "must": True}


def test_fields_of_a_dataclass_are_described_where_they_stand(read: Read) -> None:
    signature = read(
        "T",
        a='''
from dataclasses import dataclass, field
@dataclass
class Base:
    """A base.

    Args:
        height: of the image
        width: of the base
    """
    height: int = 1
    width: int = 2
@dataclass
class T(Base):
    width: int = 3
    """Of the image,
    in pixels."""
    names: tuple[str, ...] = field(default=())
    rates: dict[str, float] = field(default_factory=dict)
    height: int = 4
''',
    )
    assert signature is not None
    assert signature.meanings == {"height": "of the image", "width": "Of the image, in pixels."}
    assert {p.name: p.text for p in signature.parameters} == {
        "height": ": int = 4",
        "width": ": int = 3",
        "names": ": tuple[str, ...] = ()",
        "rates": ": dict[str, float] = dict()",
    }


OPTIONS = '''
from typing import ClassVar
from toy_b import options as _options
from toy_b.options import Base
class Runner:
    """A runner.

    Args:
        cfg: the config
        rate: as this runner takes it
    """
    Options: ClassVar[type[Base]] = _options.Base
    def __init__(self, cfg, *, seed=0, **options):
        self.extra = options.pop("extra", None)
        self.options = self.Options(**options)
class Derived(Runner):
    Options = _options.More
    def __init__(self, mine=1, **kwargs):
        kwargs.setdefault("must", 3)
        super().__init__(rate=5, **kwargs)
class Bare(Derived): ...
class Nested(Runner):
    @_options.dataclass
    class Options(Runner.Options):
        inner: int = 1
class Other(Runner):
    def __init__(self, **kwargs):
        self.kwargs = kwargs
class Plain(Runner):
    Options = dict
'''


def test_options_that_a_dataclass_states(read: Read) -> None:
    def signature(name: str) -> Signature:
        found = read_signature(Plugin("fluxvla.runners", name, f"toy_a:{name}", "fluxvla-toy", "1"))
        assert found is not None
        return found

    options = """
from dataclasses import dataclass
@dataclass(frozen=True)
class Base:
    must: int
    rate: float = 30.0
    "Commands a second."
    steps: int = 1
    "Steps."
@dataclass(frozen=True, kw_only=True)
class More(Base):
    shards: int = 2
    "Shards."
"""
    read("Runner", a=OPTIONS, **{"b/__init__": "", "b/options": options})
    runner = signature("Runner")
    assert required(runner) == {
        "cfg": True,
        "seed": False,
        "extra": False,
        "must": True,
        "rate": False,
        "steps": False,
    }
    assert not runner.open
    assert runner.meanings == {
        "cfg": "the config",
        "rate": "as this runner takes it",
        "steps": "Steps.",
    }
    places = {p.name: p.place for p in runner.parameters}
    assert places["steps"] == "toy_b/options.py:8"
    derived = required(signature("Derived"))
    assert derived == {
        "mine": False,
        "cfg": True,
        "seed": False,
        "extra": False,
        "must": False,  # filled in
        "steps": False,
        "shards": False,  # of its own Options; not rate, which it passes itself
    }
    assert required(signature("Bare")) == derived
    assert signature("Bare").meanings["shards"] == "Shards."
    assert {"inner", "steps"} <= required(signature("Nested")).keys()
    for name in ("Other", "Plain"):  # another keyword's name, and no dataclass
        assert signature(name).open
        assert "steps" not in required(signature(name))


def test_a_source_that_does_not_parse_gives_no_signature(read: Read) -> None:
    assert read("R", a="class R(:\n") is None


def test_a_function_behind_an_entry_point(read: Read) -> None:
    signature = read("make", a='def make(a, b=1, **kw):\n    """Makes."""\n')
    assert required(signature) == {"a": True, "b": False}
    assert signature is not None
    assert (signature.open, signature.doc) == (True, "Makes.")


# -- docstrings -----------------------------------------------------------------------------

DOCSTRING = """A class.

    Args:
        height, width: of the images,
            in pixels: both.

        rate (float): commands a second.
        **options: whatever
            the driver takes.

    Raises:
        ValueError: no argument.
    """


def test_the_arguments_of_a_docstring() -> None:
    assert argument_texts(DOCSTRING) == {
        "height": "of the images, in pixels: both.",
        "width": "of the images, in pixels: both.",
        "rate": "commands a second.",
        "options": "whatever the driver takes.",
    }


@pytest.mark.parametrize("text", [None, "", "A class.", "Args:", "Args:\n\nnothing: at all"])
def test_a_docstring_without_any(text: str | None) -> None:
    assert argument_texts(text) == {}


METHODS = """
class Base:
    api = "1.0"

    @property
    def size(self) -> int:  # of something
        return len(
            "a:"
        )

    def short(self): return 1
    def __init__(self, rate: float, **kwargs):
        def inner():
            return kwargs.pop("depth", 3)
        self.depth = inner()

    async def many(
        self,
        a: int = 3,
    ) -> None:
        \'\'\'A string

        with lines.\'\'\'

    def run_setup(self, *, n_train_examples: int):

        if n_train_examples:
            return
            # and no more

    LATE = 3

    class Options:
        def __init__(self): ...


class Below(Base):
    def first(self):
        return 1

    def __init__(self, path: str, **kwargs):
        super().__init__(**kwargs)
"""


@pytest.mark.parametrize(
    "more",
    [
        "",
        "\n\nclass Odd:\n    def text(self):\n        return '''\nno indentation\n'''\n",
        "\n\nclass End:\n    def last(self):\n        return 1",
    ],
)
def test_left_out_bodies_of_methods_change_nothing(read: Read, more: str) -> None:
    """Bodies are not parsed where that can be; what is found, and where, stays the same."""
    signature = read("Below", a=METHODS + more)
    assert required(signature) == {"path": True, "rate": True, "depth": False}
    assert signature is not None
    assert (signature.trains, signature.api, signature.open) == (True, "1.0", True)
    lines = {p.name: int(p.place.rpartition(":")[2]) for p in signature.parameters}
    text = METHODS.splitlines()
    assert all(name in text[line - 1] for name, line in lines.items())
    assert "class Below" in text[int(signature.place.rpartition(":")[2]) - 1]
