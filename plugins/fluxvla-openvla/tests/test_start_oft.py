"""``fluxvla openvla-oft``: the command's description."""

from __future__ import annotations

import subprocess
import sys


def test_help_needs_no_torch() -> None:
    """As an environment without torch builds the documentation of the commands."""
    code = (
        "import sys\n"
        "sys.modules['torch'] = None\n"
        "from fluxvla_core.cli.main import main\n"
        "main(['openvla-oft', '--help'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "usage: fluxvla openvla-oft" in done.stdout
