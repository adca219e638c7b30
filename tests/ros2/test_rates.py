"""Counting what arrives against what was sent."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from fluxvla_core.errors import NotReady
from fluxvla_core.ros2.startup import (
    SEGMENT_BYTES,
    ReceptionStats,
    check_losses,
    large_frames_profile,
)

VGA = 640 * 480 * 3


def stats(received, lost=0, size=VGA, reliability="best_effort", expected_hz=None, fast=True):
    return ReceptionStats("cam (/c)", reliability, 2.0, received, lost, size, expected_hz, fast)


def test_what_arrives_whole_is_fine():
    assert check_losses([stats(60), stats(60, expected_hz=30.0), stats(0)]) == []


def test_some_loss_is_a_warning():
    assert check_losses([stats(50, lost=10)]) == ["cam (/c): 50 of 60 messages arrived in 2.0 s"]


def test_a_lower_rate_than_expected_counts_as_loss():
    assert check_losses([stats(50, expected_hz=30.0)]) == [
        "cam (/c): 50 of 60 messages arrived in 2.0 s"
    ]


def test_the_shared_memory_trap_is_named_with_the_file_that_mends_it():
    with pytest.raises(NotReady) as caught:
        check_losses([stats(60), stats(1, lost=59)])

    error = caught.value
    assert error.what == "cam (/c): 1 of 60 messages arrived in 2.0 s"
    assert "larger than the 512 KB of Fast DDS's shared memory" in error.cause
    assert f"FASTDDS_DEFAULT_PROFILES_FILE={large_frames_profile()}" in error.next


def test_the_trap_is_named_even_when_nothing_ever_arrived():
    with pytest.raises(NotReady, match="0 of 50") as caught:
        check_losses([stats(0, lost=50, size=0)])

    assert "512 KB" in caught.value.cause


def test_a_sender_of_another_dds_is_not_told_of_fast_dds_file():
    with pytest.raises(NotReady) as caught:
        check_losses([stats(1, lost=59, fast=False)])

    error = caught.value
    assert "do not share Fast DDS's memory" in error.cause
    assert "net.core.rmem_max" in error.next
    # Fast DDS may freeze with reliable images of another.
    assert "RELIABLE" not in error.next
    assert "FASTDDS" not in error.next


@pytest.mark.parametrize(
    "bad",
    [
        stats(1, lost=59, size=1000),
        stats(1, lost=59, reliability="reliable"),
        stats(10, expected_hz=30.0, reliability="reliable"),
    ],
)
def test_other_losses_are_not_blamed_on_it(bad):
    with pytest.raises(NotReady) as caught:
        check_losses([bad])

    assert "512 KB" not in caught.value.cause
    assert "slower than expected" in caught.value.cause


def test_the_profile_ships_and_its_segment_holds_an_image():
    path = Path(large_frames_profile())
    space = "{http://www.eprosima.com}"
    (segment,) = ElementTree.parse(path).iter(f"{space}segment_size")

    assert int(segment.text) > 10 * VGA > SEGMENT_BYTES
