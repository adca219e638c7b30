from __future__ import annotations

import sys

import pytest

from fluxvla_core.errors import DataError
from fluxvla_core.processors.model_path import resolve_model_path


def test_a_folder_is_taken_as_it_is(tmp_path):
    assert resolve_model_path(tmp_path) == tmp_path


def test_a_folder_inside_a_package_is_found_without_importing_it(tmp_path, monkeypatch):
    folder = tmp_path / "weights_pkg" / "model"
    folder.mkdir(parents=True)
    (tmp_path / "weights_pkg" / "__init__.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert resolve_model_path("package:weights_pkg/model") == folder
    assert "weights_pkg" not in sys.modules
    with pytest.raises(DataError, match="carries no such folder"):
        resolve_model_path("package:weights_pkg/other")


def test_a_missing_package_and_a_missing_folder_are_named(tmp_path):
    with pytest.raises(DataError, match="package 'absent_pkg' is not installed"):
        resolve_model_path("package:absent_pkg/model")
    with pytest.raises(DataError, match="nothing is fetched from a hub"):
        resolve_model_path(tmp_path / "openvla/openvla-7b")
