"""A name that the core provides means the core's; of two plugins with one name neither wins."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from fluxvla_core import OPTIMIZERS, TRANSFORMS
from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.cli.main import main, overview
from fluxvla_core.config import source
from fluxvla_core.config.check import examine
from fluxvla_core.config.load import load_config
from fluxvla_core.errors import LoadFailed
from tests.conftest import Install

IMPOLITE = """
class AdamW:
    def __init__(self, betas=(0.5, 0.5)): ...
    def build(self, groups, learning_rate): raise RuntimeError("a stranger's AdamW")
class ResizeImages:
    def __init__(self, size=8): self.size = size
    def __call__(self, sample): raise RuntimeError("a stranger's ResizeImages")
"""
POINTS = """
[fluxvla.optimizers]
AdamW = acme_impolite:AdamW
[fluxvla.transforms]
ResizeImages = acme_impolite:ResizeImages
[fluxvla.heads]
ResizeImages = acme_impolite:ResizeImages
"""
BROKEN = "raise RuntimeError('broken at import')\n"
Config = Callable[[str], Path]


@pytest.fixture(autouse=True)
def _as_it_was():
    source.parse.cache_clear()
    yield
    source.parse.cache_clear()
    TRANSFORMS.unregister("ResizeImages")


@pytest.fixture(params=[IMPOLITE, BROKEN], ids=["impolite", "broken"])
def stranger(request: pytest.FixtureRequest, install: Install) -> None:
    """A distribution whose optimizer and transform have names of the core's."""
    files = {"acme_impolite.py": request.param}
    install("acme-impolite", entry_points=POINTS, files=files)


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    monkeypatch.chdir(tmp_path)

    def write(text: str) -> Path:
        (tmp_path / "c.py").write_text(textwrap.dedent(text))
        return Path("c.py")

    return write


def test_a_training_that_names_no_optimizer_trains(stranger: None, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from fluxvla_core.checkpoints.checkpoint import latest
    from fluxvla_core.testing.training import unflushed
    from tests.training.runs import run

    with unflushed():
        runner = run(tmp_path)
    assert type(runner.optimizer_settings).__module__ == "fluxvla_core.training.optimizers"
    assert latest(tmp_path).step == 6


def test_a_config_that_has_always_meant_the_cores_still_does(
    stranger: None, config: Config
) -> None:
    text = "train_dataloader = dict(dataset=dict(type='ParquetDataset', data_root_path='d', "
    text += "img_keys=['front'], "
    text += "transforms=[dict(type='ResizeImages', height=8, width=8)]))\n"
    found = examine(load_config(config(text)))
    assert found.problems == ()
    assert {use.found.origin.partition(" ")[0] for use in found.uses} == {"fluxvla-core"}
    built = build_transform_from_cfg({"type": "ResizeImages", "height": 8, "width": 8})
    assert type(built).__module__ == "fluxvla_core.data.transforms.images"


def test_a_variable_whose_key_names_no_registry_means_the_cores(
    stranger: None, config: Config
) -> None:
    """The stranger has a ``ResizeImages`` among the heads, too."""
    found = examine(load_config(config("small = dict(type='ResizeImages', height=8, width=8)\n")))
    assert found.problems == ()
    (use,) = found.uses
    assert (use.found.registry, use.found.origin.partition(" ")[0]) == (
        "transforms",
        "fluxvla-core",
    )


def test_the_strangers_is_reached_with_its_distribution(install: Install, config: Config) -> None:
    install("acme-impolite", entry_points=POINTS, files={"acme_impolite.py": IMPOLITE})
    text = "train_dataloader = dict(dataset=dict(type='ParquetDataset', data_root_path='d', "
    text += "img_keys=['front'], "
    text += "transforms=[dict(type='acme-impolite:ResizeImages', size=3)]))\n"
    assert examine(load_config(config(text))).problems == ()
    table = {"type": "Acme_Impolite:ResizeImages", "size": 3}
    assert build_transform_from_cfg(table).size == 3
    assert "acme-impolite:AdamW" in OPTIMIZERS
    assert "acme-other:AdamW" not in OPTIMIZERS


def test_a_plugin_that_registers_a_name_of_the_cores_hurts_itself_alone(install: Install) -> None:
    source = "from fluxvla_core import TRANSFORMS\n@TRANSFORMS.register_module()\n"
    source += "class ResizeImages:\n    def __call__(self, sample): ...\nclass Crop(ResizeImages): "
    source += "...\n"
    points = "[fluxvla.transforms]\nAcmeCrop = acme_rude:Crop\n"
    install("acme-rude", entry_points=points, files={"acme_rude.py": source})
    with pytest.raises(LoadFailed, match="'ResizeImages' is the core's own and acme_rude") as error:
        TRANSFORMS.get("AcmeCrop")
    assert "acme-rude 1.0" in str(error.value)
    assert TRANSFORMS.get("ResizeImages").__module__ == "fluxvla_core.data.transforms.images"


def test_a_person_may_replace_the_cores_in_this_process_by_saying_so() -> None:
    class ResizeImages:
        def __call__(self, sample): ...

    with pytest.raises(LoadFailed, match="say force=True"):
        TRANSFORMS.register_module()(ResizeImages)
    TRANSFORMS.register_module(force=True)(ResizeImages)
    assert TRANSFORMS.get("ResizeImages") is ResizeImages


def test_of_two_plugins_with_one_name_neither_wins(
    install: Install, config: Config, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = "class AcmeArm:\n    def __init__(self, port=1): ...\n    def get_frame(self): ...\n"
    for dist in ("acme-arm", "zeta-arm"):
        module = dist.replace("-", "_")
        points = f"[fluxvla.operators]\nAcmeArm = {module}:AcmeArm\n"
        install(dist, entry_points=points, files={f"{module}.py": arm})
    file = config("a = 1\nrobot = dict(\n    operator=dict(type='AcmeArm'))\n")
    assert main(["config", "check", str(file)]) == 2
    said = capsys.readouterr().err
    assert (
        "c.py:3: robot.operator.type: fluxvla.operators: 'AcmeArm' is provided by acme-arm 1.0 "
        "(acme_arm:AcmeArm), zeta-arm 1.0 (zeta_arm:AcmeArm): write type='acme-arm:AcmeArm' or "
        "type='zeta-arm:AcmeArm' to choose, or uninstall one"
    ) in said
    assert main(["config", "check", str(config("robot = dict(operator=dict(port=1))\n"))]) == 0


COMMAND = """
class Go:
    help = "Go there."
    def add_arguments(self, parser): ...
    def run(self, args):
        print("{dist} went")
        return 0
"""


def test_commands_of_one_name_and_commands_of_the_cores_names(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    for dist in ("acme-go", "zeta-go"):
        module = dist.replace("-", "_")
        points = f"[fluxvla.commands]\ngo = {module}:Go\n"
        points += f"config = {module}:Go\n" if dist == "acme-go" else ""
        files = {f"{module}.py": COMMAND.format(dist=dist)}
        install(dist, entry_points=points, files=files)
    assert main(["go"]) == 2
    assert "run fluxvla acme-go:go or fluxvla zeta-go:go, or uninstall one" in (
        capsys.readouterr().err
    )
    assert main(["zeta-go:go"]) == 0
    assert capsys.readouterr().out == "zeta-go went\n"
    assert main(["acme-go:config"]) == 0
    assert capsys.readouterr().out == "acme-go went\n"
    assert main(["config"]) == 0
    assert "went" not in capsys.readouterr().out
    listed = [line.split()[0] for line in overview().splitlines() if "Go there" in line]
    assert listed == ["acme-go:config", "acme-go:go", "zeta-go:go"]


def test_a_command_in_a_misspelt_group(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"acme_go.py": COMMAND.format(dist="acme-go")}
    install("acme-go", entry_points="[fluxvla_command]\ngo = acme_go:Go\n", files=files)
    assert main(["go"]) == 2
    assert capsys.readouterr().err.startswith(
        "no command 'go'; acme-go 1.0: go is in 'fluxvla_command', which nothing reads; did its "
        "author mean 'fluxvla.commands'?\n"
    )
