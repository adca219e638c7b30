from __future__ import annotations

import subprocess
import sys

import pytest

from fluxvla_core.data import files
from fluxvla_core.errors import ConfigError


@pytest.mark.parametrize(("door", "package"), [("libav", "av"), ("parquet", "pyarrow")])
def test_a_package_that_is_missing_is_named_with_its_command(door, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, f"{package}.parquet", None)
    with pytest.raises(ConfigError) as caught:
        getattr(files, door)()
    assert f"datasets need the package {package}, which cannot be imported" in str(caught.value)
    assert "pip install 'fluxvla-core[data]'" in str(caught.value)


def test_importing_the_room_loads_no_heavy_package():
    code = (
        "import sys, pkgutil, importlib\n"
        "import fluxvla_core.data as room\n"
        "for module in pkgutil.walk_packages(room.__path__, room.__name__ + '.'):\n"
        "    importlib.import_module(module.name)\n"
        "heavy = {'torch', 'cv2', 'av', 'pyarrow', 'pandas', 'tokenizers', 'rich'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
