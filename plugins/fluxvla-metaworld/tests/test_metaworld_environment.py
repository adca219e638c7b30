"""Meta-World behind the contract does what every environment must."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import EnvironmentConformance


@pytest.mark.usefixtures("metaworld")
class TestMetaWorldEnvironment(EnvironmentConformance):
    entry_point = "MetaWorldEnvironment"
    tasks = ("push-v3", "door-open-v3")
