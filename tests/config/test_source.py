"""Which class a name stands for, read from source: aliases, re-exports, bases and their order."""

from __future__ import annotations

import sys
from typing import Any

from fluxvla_core.config.source import Opaque, Source, find, linearize
from tests.conftest import Install


def test_re_exports_aliases_stars_and_lazy_tables(install: Install) -> None:
    install(
        "fluxvla-toy",
        files={
            "toy_pkg/__init__.py": (
                "from __future__ import annotations\n"
                "import importlib\n"
                "from .sub import *\n"
                "from . import deep as d\n"
                "_EXPORTS: dict[str, str] = {'Lazy': 'toy_pkg.lazy', 'Other': 'toy_pkg.lazy'}\n"
                "Alias = d.Deep\n"
                "if True:\n    from .tried import Tried\n"
                "else:\n    Tried = None\n"
                "try:\n    from .tried import Again\nexcept ImportError:\n    class Again: pass\n"
            ),
            "toy_pkg/sub.py": "class Star:\n    class Inner: ...\n",
            "toy_pkg/deep.py": "class Deep: ...\n",
            "toy_pkg/lazy.py": "class Lazy: ...\n",
            "toy_pkg/tried.py": "class Tried: ...\nclass Again: ...\n",
            "toy_user.py": (
                "import toy_pkg\nimport toy_pkg.deep\nfrom toy_pkg import deep\n"
                "class A(toy_pkg.Lazy): ...\n"
                "class B(toy_pkg.deep.Deep): ...\n"
                "class C(deep.Deep): ...\n"
            ),
        },
    )
    for dotted in ("Star", "Star.Inner", "Lazy", "Alias", "Tried", "Again", "sub.Star"):
        found = find("toy_pkg", dotted)
        assert isinstance(found, Source), dotted
    assert find("toy_pkg", "Gone") == Opaque("toy_pkg.Gone")
    assert find("toy_pkg", "Star.Gone") == Opaque("toy_pkg.Star.Gone")
    assert find("toy_gone", "X") == Opaque("toy_gone.X")
    for name in "ABC":
        cls = find("toy_user", name)
        assert isinstance(cls, Source)
        assert len(linearize(cls)) == 2
        assert isinstance(linearize(cls)[1], Source)
    assert not [m for m in sys.modules if m.startswith("toy_")]


def test_the_cores_own_lazy_names_are_followed() -> None:
    found = find("fluxvla_core", "RunContext")
    assert isinstance(found, Source)
    assert found.place.startswith("fluxvla_core/build.py:")


def test_relative_imports_over_several_levels(install: Install) -> None:
    install(
        "fluxvla-toy",
        files={
            "toy_deep/__init__.py": "from ._base import Base\n",
            "toy_deep/_base.py": "class Base: ...\n",
            "toy_deep/a/__init__.py": "",
            "toy_deep/a/b.py": (
                "from ... import toy_none\nfrom .. import _base\nfrom .._base import Base\n"
                "class A(Base): ...\nclass B(_base.Base): ...\n"
            ),
        },
    )
    for name in "AB":
        cls = find("toy_deep.a.b", name)
        assert isinstance(cls, Source)
        assert isinstance(linearize(cls)[1], Source)


def test_bases_that_python_would_refuse_are_still_listed(install: Install) -> None:
    text = "class A: ...\nclass B(A): ...\nclass C(A, B): ...\n"
    install("fluxvla-toy", files={"toy_bad.py": text})
    cls = find("toy_bad", "C")
    assert isinstance(cls, Source)
    assert len(linearize(cls)) == 3


def test_circular_imports_end(install: Install) -> None:
    install(
        "fluxvla-toy",
        files={"toy_a.py": "from toy_b import X\n", "toy_b.py": "from toy_a import X\n"},
    )
    assert isinstance(find("toy_a", "X"), Opaque)


def test_linearize_matches_python(install: Install) -> None:
    text = (
        "class O: ...\nclass A(O): ...\nclass B(O): ...\nclass C(O): ...\n"
        "class D(A, B): ...\nclass E(B, C): ...\nclass F(D, E): ...\n"
    )
    install("fluxvla-toy", files={"toy_mro.py": text})
    space: dict[str, Any] = {}
    exec(text, space)
    cls = find("toy_mro", "F")
    assert isinstance(cls, Source)
    names = [s.node.name for s in linearize(cls) if isinstance(s, Source)]
    assert names == [c.__name__ for c in space["F"].__mro__[:-1]]
