"""Meta-World's scenes, where it is installed."""

from __future__ import annotations

import pytest
from fluxvla_metaworld.environment import is_installed


@pytest.fixture(scope="session")
def metaworld():
    """Skips where Meta-World cannot be had."""
    if not is_installed():
        pytest.skip("Meta-World is not installed (fluxvla-metaworld[metaworld])")
    from fluxvla_metaworld.environment import import_metaworld

    return import_metaworld()


@pytest.fixture(scope="module")
def environment(metaworld):
    """One environment for a module's tests."""
    from fluxvla_metaworld.environment import MetaWorldEnvironment

    made = MetaWorldEnvironment()
    yield made
    made.close()
