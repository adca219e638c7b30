"""Hints that name a key are whole options."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fluxvla_core.config.overrides import complete, complete_hints
from fluxvla_core.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
CONFIG = {
    "train": {"transforms": [{"type": "Crop"}, {"type": "fluxvla-core:Pad"}]},
    "eval": {"dataset": {"transforms": [{"type": "Crop"}, {"type": "Twice"}, {"type": "Twice"}]}},
}
BARE = re.compile(r'next=\(?\s*f?"[^"\n]*(?<!--)\bset [a-z_]+ ?=')


@pytest.mark.parametrize(
    ("hint", "whole"),
    [
        ("--set <Pad>.width=3 or more", "--set train.transforms.1.width=3 or more"),
        ("--set '<Pad>.sizes=[1, 2]'", "--set 'train.transforms.1.sizes=[1, 2]'"),
        ("--set <Crop>.width=3", "--set eval.dataset.transforms.0.width=3"),
        ("--set <section>.seed=3", "--set eval.seed=3"),
        ("--set <Gone>.width=3", "--set <Gone>.width=3"),
        (
            "--set <Twice>.width=3",
            "--set <Twice>.width=3 "
            "(<Twice> is eval.dataset.transforms.1 or eval.dataset.transforms.2)",
        ),
        ("fluxvla data collect --help", "fluxvla data collect --help"),
    ],
)
def test_a_hint_gets_the_keys_of_the_tables(hint, whole):
    assert complete(hint, CONFIG, "eval") == whole


def test_an_error_that_passes_is_completed():
    with pytest.raises(ConfigError) as caught, complete_hints(CONFIG):
        raise ConfigError("too narrow", next="--set <Pad>.width=3")
    assert caught.value.next == "--set train.transforms.1.width=3"
    with pytest.raises(ConfigError) as caught, complete_hints(CONFIG):
        raise ConfigError("too narrow", next="--set <section>.width=3")
    assert caught.value.next == "--set <section>.width=3", "no section runs"


SECTION = re.compile(
    r'"[^"\n]*--set \'?(?:runner|eval|inference)\.|^\s*"(?:runner|eval|inference)\.\w+=', re.M
)


def test_no_hint_assumes_the_name_of_a_section():
    """A config may call its sections anything: ``<section>`` becomes the one that runs."""
    sources = [*ROOT.glob("src/**/*.py"), *ROOT.glob("plugins/*/src/**/*.py")]
    found = {path.name for path in sources if SECTION.search(path.read_text(encoding="utf-8"))}
    assert found == set()


def test_no_hint_names_a_bare_key():
    sources = [*ROOT.glob("src/**/*.py"), *ROOT.glob("plugins/*/src/**/*.py")]
    assert len(sources) > 100
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in sources
        # what drives a robot names its own keys.
        if "fluxvla_core/robot" not in path.as_posix()
        for match in BARE.finditer(path.read_text(encoding="utf-8"))
    ]
    assert found == []
