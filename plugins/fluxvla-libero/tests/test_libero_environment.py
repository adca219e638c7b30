"""LIBERO behind the contract does what every environment must."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import EnvironmentConformance


@pytest.mark.usefixtures("libero")
class TestLiberoEnvironment(EnvironmentConformance):
    entry_point = "LiberoEnvironment"
    arguments = {"tasks": (2,)}  # noqa: RUF012
    steps = 4
