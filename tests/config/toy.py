"""A plugin with a class for each part of a config, and what a check of a config finds."""

from __future__ import annotations

import pytest

from fluxvla_core.config.check import check_config
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.errors import ConfigError
from tests.conftest import Install

from .conftest import Write

__all__ = ["FILES", "GOOD", "POINTS", "_toy", "findings"]

POINTS = """
[fluxvla.runners]
ToyTrainRunner = toy.runners:ToyTrainRunner
ToyInferenceRunner = toy.runners:ToyInferenceRunner
[fluxvla.operators]
ToyOperator = toy.robot:ToyOperator
ToySimOperator = toy.robot:ToySimOperator
[fluxvla.datasets]
ToyDataset = toy.data:ToyDataset
[fluxvla.transforms]
ToyResize = toy.data:ToyResize
[fluxvla.vlas]
ToyVLA = toy.data:ToyVLA
[fluxvla.hooks]
ToyHook = toy.data:ToyHook
"""
FILES = {
    "toy/__init__.py": "raise RuntimeError('a check must not import')\n",
    "toy/runners.py": """
class Base:
    def __init__(self, cfg, context=None, learning_rate=1e-4, warmup_ratio=0.0, collator=None): ...
class ToyTrainRunner(Base):
    def __init__(self, max_epochs, **kwargs):
        super().__init__(**kwargs)
    def run_setup(self, n_train_examples): ...
class ToyInferenceRunner:
    def __init__(self, operator, task_descriptions, dataset=None, context=None): ...
    def run_setup(self): ...
""",
    "toy/robot.py": """
class ToyOperator:
    def __init__(self, topic, rate=30): ...
class ToySimOperator:
    def __init__(self, seed=0): ...
""",
    "toy/data.py": """
class ToyDataset:
    def __init__(self, data_root_path, transforms=()): ...
class ToyResize:
    def __init__(self, height, width): ...
class ToyVLA:
    def __init__(self, width=8, vision_backbone=None): ...
class ToyHook:
    def __init__(self, every=1): ...
""",
}
GOOD = """\
model = dict(type='ToyVLA')
train_dataloader = dict(
    per_device_batch_size=8,
    dataset=dict(type='ToyDataset', data_root_path='d',
                 transforms=[dict(type='ToyResize', height=1, width=2)]))
runner = dict(type='ToyTrainRunner', max_epochs=1)
inference = dict(type='ToyInferenceRunner', task_descriptions={'1': 'lift'},
                 operator=dict(type='ToyOperator', topic='/a'))
"""


@pytest.fixture(autouse=True)
def _toy(install: Install) -> None:
    install("fluxvla-toy", entry_points=POINTS, files=FILES)


def findings(text: str, write: Write, section: str | None = None, *overrides: str) -> str:
    config = apply_overrides(load_config(write("c.py", text)), overrides)
    with pytest.raises(ConfigError) as caught:
        check_config(config, section)
    assert caught.value.exit_code == 2
    return str(caught.value)
