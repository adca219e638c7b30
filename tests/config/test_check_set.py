"""Checking a config: what it requires, what ``--set`` may name, and that nothing is imported."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.config.check import examine
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.config.resolve import INJECTED
from fluxvla_core.config.tree import Config
from fluxvla_core.errors import ConfigError

from .conftest import Write
from .toy import GOOD, _toy, findings

__all__ = ["_toy"]


# -- requires --------------------------------------------------------------------------------


def test_requirements(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    text = findings(
        "requires = ['fluxvla-core>=99', 'nobody-has-this>=1', 'nor-has-anybody-this', '>=1',\n"
        "  'pip>=1', \"nobody-has-this; python_version < '3'\"]\n",
        write,
    )
    lines = text.splitlines()
    assert lines[0] == "4 problems in the config:"
    assert "requires.0: needs fluxvla-core>=99, but fluxvla-core " in lines[1]
    assert lines[2].endswith("requires.1: needs nobody-has-this>=1, which is not installed")
    assert "requires.3: '>=1' is not a requirement (PEP 508): " in lines[4]
    assert "requires: must be a list like ['fluxvla-ur>=0.3'], got 'pip'" in findings(
        "requires = 'pip'\n", write
    )


def test_only_our_own_names_come_with_a_command(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fluxvla_core.config.check.version", lambda name: None)
    text = findings("requires = ['Fluxvla_UR>=0.3', 'acme-ur']\n", write)
    assert "needs Fluxvla_UR>=0.3, which is not installed: pip install Fluxvla_UR" in text
    assert "needs acme-ur, which is not installed" in text
    assert "pip install acme-ur" not in text


# -- what --set may name ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "key",
    [
        "runner.learning_rate",  # by way of **kwargs
        "inference.operator.rate",
        "inference.dataset",
        "train_dataloader.per_device_num_workers",
        "model.vision_backbone",
    ],
)
def test_set_takes_what_the_class_of_the_table_takes(write: Write, key: str) -> None:
    config = apply_overrides(load_config(write("c.py", GOOD)), [f"{key}=1"])
    assert config.where(key) == f"--set {key}=1"


@pytest.mark.parametrize(
    ("override", "why"),
    [
        (
            "runner.learning_rte=1",
            "no 'runner.learning_rte' in the config, and ToyTrainRunner takes no 'learning_rte'; "
            "did you mean --set runner.learning_rate=1?",
        ),
        (
            "runner.warmup_steps=500",
            "no 'runner.warmup_steps' in the config, and ToyTrainRunner takes no 'warmup_steps'; "
            "did you mean --set runner.warmup_ratio=… (the share of the run's steps, from 0 to 1)?",
        ),
        (
            "inference.operator.zzz=[1, 2]",
            "no 'inference.operator.zzz' in the config, and ToyOperator takes no 'zzz'",
        ),
        (
            "runner.collator.keys=['a']",
            "no 'runner.collator' in the config yet: give the whole table, --set "
            "'runner.collator={keys = ...}'",
        ),
        (
            "runner.context=1",
            "no 'runner.context' in the config, and ToyTrainRunner takes no 'context'",
        ),
        (
            "train_dataloader.per_device_num_worker=1",
            "no 'train_dataloader.per_device_num_worker' in the config; did you mean --set "
            "train_dataloader.per_device_num_workers=1? [to add it: --set "
            "train_dataloader.per_device_num_worker+=1]",
        ),
    ],
)
def test_set_of_what_the_class_does_not_take_is_refused(
    write: Write, override: str, why: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        apply_overrides(load_config(write("c.py", GOOD)), [override])
    assert str(caught.value).endswith(f"--set {override}: {why}")


def test_set_on_a_table_of_a_class_that_is_not_there(write: Write) -> None:
    config = load_config(write("c.py", GOOD.replace("'ToyOperator'", "'Nobody'")))
    with pytest.raises(ConfigError) as caught:
        apply_overrides(config, ["inference.operator.rate=1"])
    assert str(caught.value).endswith(
        "no 'inference.operator.rate' in the config [to add it: --set inference.operator.rate+=1]"
    )


def test_every_key_of_every_class_that_a_config_of_ours_names_can_be_set() -> None:
    pytest.importorskip("fluxvla_sim")
    config = load_config(Path(__file__).parents[2] / "configs" / "aloha_sim_transfer.py")
    uses = [use for use in examine(config).uses if use.found.signature is not None]
    keys = [
        f"{use.key}.{name}={{}}"
        for use in uses
        for name in use.found.signature.names
        if name not in INJECTED
    ]
    assert "eval.live={}" in keys
    for key in keys:
        apply_overrides(config, [key])


# -- nothing is imported ---------------------------------------------------------------------


def test_a_check_imports_nothing_heavy_and_no_plugin(write: Write) -> None:
    write("c.py", GOOD)
    code = (
        "import sys\n"
        "from fluxvla_core.config.check import check_config\n"
        "from fluxvla_core.config.load import load_config\n"
        "check_config(load_config('c.py'))\n"
        "heavy = {'torch', 'numpy', 'cv2', 'pyarrow', 'av', 'rich', 'toy', 'tomli'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    path = ":".join(p for p in sys.path if p)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={"PYTHONPATH": path, "PATH": "/usr/bin"},
        check=False,
    )
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_an_empty_config_has_no_sections() -> None:
    assert examine(Config({})).sections == ()
