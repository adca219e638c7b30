from __future__ import annotations

import re
from pathlib import Path

import pytest
import tomli
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from fluxvla_core import OPERATORS, RUNNERS, Registry
from fluxvla_core.errors import AmbiguousPlugin, IncompatiblePlugin, LoadFailed, MissingPlugin
from fluxvla_core.plugins import first_party
from fluxvla_core.plugins._metadata import Plugin, version
from fluxvla_core.plugins.load import unmet

ROOT = Path(__file__).parents[2]
OPERATOR = "class {name}:\n    api = '1.0'\n    def get_frame(self): return {{}}\n"


def entry(name: str, value: str, group: str = "operators") -> str:
    return f"[fluxvla.{group}]\n{name} = {value}\n"


def test_only_the_named_class_is_imported(install):
    install(
        "fluxvla-a",
        entry_points=entry("A", "mod_a:A"),
        files={"mod_a.py": OPERATOR.format(name="A")},
    )
    install(
        "fluxvla-b", entry_points=entry("B", "mod_b:B"), files={"mod_b.py": "raise RuntimeError"}
    )
    assert OPERATORS.get("A").__name__ == "A"


def test_a_misspelt_name_gets_a_suggestion(install):
    install("fluxvla-a", entry_points=entry("ArmOperator", "mod_a:A"))
    with pytest.raises(MissingPlugin, match="did you mean 'ArmOperator'") as error:
        OPERATORS.get("ArmOperatr")
    assert "next: fluxvla plugins list" in str(error.value)
    assert error.value.exit_code == 2


def test_a_missing_first_party_plugin_is_named_with_its_pip_command(monkeypatch):
    monkeypatch.setattr(first_party, "FIRST_PARTY", {"fluxvla-acme": {"runners": ("AcmeRunner",)}})
    with pytest.raises(MissingPlugin, match=r"pip install fluxvla-acme"):
        RUNNERS.get("AcmeRunner")
    with pytest.raises(MissingPlugin, match=r"did you mean 'AcmeRunner'\? \(fluxvla-acme provides"):
        RUNNERS.get("AcmeRuner")


def test_no_pip_command_is_made_up_from_what_was_typed():
    with pytest.raises(MissingPlugin) as error:
        RUNNERS.get("EvilPackageRunner")
    assert "pip install" not in str(error.value)


def test_two_providers_are_an_error_that_lists_both(install):
    for dist in ("acme-arm", "fluxvla-arm"):
        name = dist.replace("-", "_")
        install(
            dist,
            entry_points=entry("Arm", f"{name}:Arm"),
            files={f"{name}.py": OPERATOR.format(name="Arm")},
        )
    with pytest.raises(AmbiguousPlugin) as error:
        OPERATORS.get("Arm")
    text = str(error.value)
    assert "acme-arm 1.0 (acme_arm:Arm), fluxvla-arm 1.0 (fluxvla_arm:Arm)" in text
    assert "type='acme-arm:Arm' or type='fluxvla-arm:Arm'" in text
    assert OPERATORS.get("acme-arm:Arm").__module__ == "acme_arm"
    assert OPERATORS.get("fluxvla_arm:Arm").__module__ == "fluxvla_arm"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "its own module 'mod_x' is missing"),
        ("\nimport rclpy_absent", "'rclpy_absent', which is not installed (mod_x.py:2)"),
        ("raise OSError('no display')", "raised OSError on import: no display (mod_x.py:1)"),
        ("class X", "raised SyntaxError on import: expected ':' (mod_x.py:1)"),
        ("raise SystemExit(3)", "raised SystemExit on import: 3"),
        ("Y = 1", "names an object that does not exist"),
        ("X = 1", "is a int, not a class"),
        ("class X: pass", "get_frame() is missing"),
        ("class X:\n    get_frame = 3", "get_frame is a int, not a method"),
        ("class X:\n    def get_frame(self, slop): pass", "get_frame() must accept no argument"),
    ],
)
def test_a_plugin_that_cannot_be_loaded_says_why(install, source, message):
    files = {} if source is None else {"mod_x.py": source}
    install("fluxvla-x", version="0.3", entry_points=entry("X", "mod_x:X"), files=files)
    with pytest.raises(LoadFailed, match=re.escape(message)) as error:
        OPERATORS.get("X")
    assert "fluxvla-x 0.3" in str(error.value)
    with pytest.raises(LoadFailed) as again:  # remembered, not tried again
        OPERATORS.get("X")
    assert again.value is error.value


def test_a_requirement_on_another_core_is_checked_before_import(install):
    install(
        "fluxvla-old",
        entry_points=entry("Old", "mod_old:Old"),
        files={"mod_old.py": "raise RuntimeError('imported')"},
        requires=("fluxvla-core<0.0.1",),
    )
    with pytest.raises(
        IncompatiblePlugin, match=r"fluxvla-old 1\.0 needs fluxvla-core<0\.0\.1, but"
    ):
        OPERATORS.get("Old")


@pytest.mark.parametrize(
    "text",
    [
        *("fluxvla-core", "fluxvla-core>=0.1", "fluxvla-core[data]>=0.1,<0.2", "Fluxvla_Core>=0.1"),
        *("fluxvla-core (>=0.1.0)", "fluxvla-core>0.0.9, <=0.1.0.0", "fluxvla-core>0.1"),
        *("fluxvla-core<0.1", "fluxvla-core<=0.0.99", "fluxvla-core>=0.2", "fluxvla-core==0.1.0"),
        *("fluxvla-core~=0.1.0", "fluxvla-core!=0.1.0", "fluxvla-core>=0.1.0rc1", "numpy<0"),
        *("fluxvla-core<0.1; extra == 'old'", "fluxvla-core<0.1; python_version > '3'"),
        *("fluxvla-core>=0.10", "fluxvla-core<0.10", "fluxvla-core>=1", "fluxvla-core==0.1.*"),
    ],
)
def test_requirements_on_the_core_are_read_as_packaging_reads_them(text):
    """Most are decided without importing packaging, which takes long."""
    asked = Requirement(text)
    applies = canonicalize_name(asked.name) == "fluxvla-core" and (
        asked.marker is None or asked.marker.evaluate({"extra": ""})
    )
    met = not applies or asked.specifier.contains(version("fluxvla-core"), prereleases=True)
    plugin = Plugin("fluxvla.operators", "X", "x:X", "fluxvla-x", "1", (text,))
    assert (unmet(plugin) is None) == met


@pytest.mark.parametrize(
    ("api", "upgrade"), [("1.9", "fluxvla-core"), ("2.0", "fluxvla-core"), ("0.9", "fluxvla-x")]
)
def test_the_contract_version_is_caret_checked(install, api, upgrade):
    source = f"class X:\n    api = '{api}'\n    def get_frame(self): pass"
    install("fluxvla-x", entry_points=entry("X", "mod_x:X"), files={"mod_x.py": source})
    with pytest.raises(IncompatiblePlugin) as error:
        OPERATORS.get("X")
    assert f"written for operators {api}, this core speaks 1.0" in str(error.value)
    assert f"pip install --upgrade {upgrade}" in str(error.value)


def test_register_module_serves_this_process_only():
    registry = Registry("operators")

    @registry.register_module()
    class Mine:
        def get_frame(self) -> dict:
            return {}

    assert registry.get("Mine") is Mine
    assert "Mine" in registry
    with pytest.raises(LoadFailed, match="already registered in this process"):
        registry.register_module("Mine")(type("Other", (Mine,), {}))
    registry.unregister("Mine")
    assert "Mine" not in registry


def test_a_type_never_resolves_to_an_import_path():
    with pytest.raises(MissingPlugin):
        RUNNERS.get("subprocess.check_output")
    with pytest.raises(MissingPlugin):
        RUNNERS.get("subprocess:check_output")


def test_the_table_of_first_party_names_equals_their_pyproject_files():
    stated: dict[str, dict[str, tuple[str, ...]]] = {}
    for file in sorted((ROOT / "plugins").glob("*/pyproject.toml")):
        project = tomli.loads(file.read_text())["project"]
        if "entry-points" not in project:  # a library of plugins
            continue
        stated[project["name"]] = {
            group.removeprefix("fluxvla."): tuple(sorted(names))
            for group, names in project["entry-points"].items()
        }
    table = {
        d: {r: tuple(sorted(n)) for r, n in t.items()} for d, t in first_party.FIRST_PARTY.items()
    }
    assert table == stated


@pytest.mark.parametrize("version", ["4.40.0", "6.1"])
def test_a_version_of_transformers_that_is_not_exact_is_refused_before_import(install, version):
    """Two of its versions may give other numbers of the same weights."""
    install("transformers", version=version)
    install(
        "fluxvla-old",
        entry_points=entry("Old", "mod_old:Old"),
        files={"mod_old.py": "raise RuntimeError('imported')"},
        requires=("fluxvla-core>=0.1", "numpy<0", "transformers<6,>=5.5"),
    )
    with pytest.raises(
        IncompatiblePlugin, match=rf"fluxvla-old 1\.0 needs transformers>=5\.5,<6, but {version} is"
    ) as error:
        OPERATORS.get("Old")
    assert error.value.next == "pip install 'transformers>=5.5,<6'"


def test_a_version_of_transformers_that_is_exact_is_not_looked_at_twice(install):
    install("transformers", version="5.7.1")
    install(
        "fluxvla-a",
        entry_points=entry("A", "mod_a:A"),
        files={"mod_a.py": OPERATOR.format(name="A")},
        requires=("transformers>=5.5,<6",),
    )
    assert OPERATORS.get("A").__name__ == "A"
