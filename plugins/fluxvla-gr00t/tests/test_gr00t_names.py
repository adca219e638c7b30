"""Names of weights: every published tensor has one of ours of the same shape, and none is left."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fluxvla_gr00t.names import is_unread, key_map

from .gr00t_sizes import published

KEYS = Path(__file__).parent / "keys"
# As the published weights are counted, with the parts that are not read.
PARAMETERS = {"n1.5": 2_724_163_520, "n1.7": 3_144_016_000}


def listed(version):
    file = {"n1.5": "gr00t_n15.json", "n1.7": "gr00t_n17.json"}[version]
    return {k: tuple(v) for k, v in json.loads((KEYS / file).read_text()).items()}


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_names_cover_the_published_file_both_ways(version):
    ours = {name: tuple(value.shape) for name, value in published(version).state_dict().items()}
    mapped = key_map(ours, version)
    assert len(mapped) == len(ours)
    theirs = {k: shape for k, shape in listed(version).items() if not is_unread(k, version)}
    assert {name: ours[own] for name, own in mapped.items()} == theirs


@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_parameters_are_as_many_as_published(version):
    unread = [shape for name, shape in listed(version).items() if is_unread(name, version)]
    if version == "n1.7":
        # The output layer is the embedding's own tensor, counted once.
        unread = [shape for shape in unread if len(shape) == 1]
    own = sum(p.numel() for p in published(version).parameters())
    extra = sum(_size(shape) for shape in unread)
    assert own + extra == PARAMETERS[version]


def _size(shape):
    total = 1
    for side in shape:
        total *= side
    return total
