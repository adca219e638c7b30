"""``--plugin`` files: where others find them, and that they can be forgotten."""

from __future__ import annotations

import sys

import pytest

from fluxvla_core import HOOKS
from fluxvla_core.errors import LoadFailed, UsageError
from fluxvla_core.plugins.registry import forget_plugin_files, load_plugin_files, plugin_files

GOOD = """
from fluxvla_core import HOOKS

@HOOKS.register_module()
class Watcher:
    def run_started(self): ...
"""


def test_loaded_files_can_be_found_and_forgotten(tmp_path, monkeypatch):
    (tmp_path / "my-watch.py").write_text(GOOD)
    monkeypatch.chdir(tmp_path)
    load_plugin_files(["my-watch.py"])
    assert plugin_files() == (str(tmp_path / "my-watch.py"),)
    assert HOOKS.get("Watcher").__module__ == "fluxvla_plugin_my_watch"
    forget_plugin_files()
    assert plugin_files() == ()
    assert HOOKS.registered("Watcher") is None
    assert "fluxvla_plugin_my_watch" not in sys.modules


def test_a_file_that_failed_is_not_among_them(tmp_path):
    (tmp_path / "bad.py").write_text("x = 1\n1 / 0\n")
    with pytest.raises(LoadFailed, match=r"raised ZeroDivisionError") as caught:
        load_plugin_files([tmp_path / "bad.py"])
    assert caught.value.where == f"{tmp_path / 'bad.py'}:2"
    with pytest.raises(UsageError, match="there is no such file"):
        load_plugin_files([tmp_path / "gone.py"])
    assert plugin_files() == ()
