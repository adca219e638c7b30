"""Reading checkpoints: what is whole, what is damaged, and what is offered instead."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.checkpoints import checkpoint
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest, newest_undamaged
from fluxvla_core.checkpoints.manifest import FileEntry, Manifest, read_manifest
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.errors import CheckpointError
from fluxvla_core.spec import EmbodimentSpec, Joint

SPEC = EmbodimentSpec("arm", (Joint("j", "rad", -1.0, 1.0, 1.0, 1.0),), (), 10.0)


def write(work_dir, step):
    with CheckpointWriter(work_dir, step, 3) as writer:
        writer.write_bytes("model.safetensors", bytes(range(200)))
        writer.write_json("config.resolved.json", {"config": {"a": 1}, "origins": {}})
        writer.write_json("embodiment.json", SPEC.to_dict())
        writer.write_json("policy.json", {"action_rate_hz": 10.0, "horizon": 2})
        writer.write_json("dataset_statistics.json", {"private": {}})
        writer.write_bytes("rng/rank-00000.safetensors", b"abc")
        return writer.commit()


def test_what_a_checkpoint_says(tmp_path):
    found = Checkpoint.open(write(tmp_path, 70))
    found.verify()
    assert (found.step, found.epoch) == (70, 3)
    assert found.config() == {"a": 1}
    assert found.policy() == {"action_rate_hz": 10.0, "horizon": 2}
    assert found.statistics() == {"private": {}}
    assert found.embodiment() == SPEC
    assert found.processors == found.path / "processors"


def test_metadata_is_read_without_torch(tmp_path):
    code = (
        "import sys; from fluxvla_core.checkpoints.checkpoint import latest\n"
        "found = latest(sys.argv[1]); found.verify(); found.embodiment(); found.config()\n"
        "sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    )
    write(tmp_path, 1)
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)


def test_no_embodiment_is_none_and_no_file_is_an_error(tmp_path):
    with CheckpointWriter(tmp_path, 1, 0) as writer:
        path = writer.commit()
    assert Checkpoint.open(path).embodiment() is None
    with pytest.raises(CheckpointError, match=r"the checkpoint has no policy\.json"):
        Checkpoint.open(path).policy()
    with pytest.raises(CheckpointError, match=r"the checkpoint has no model\.safetensors"):
        Checkpoint.open(path).tensors("model.safetensors")


@pytest.mark.parametrize("text", ["[1]", "{"])
def test_json_that_is_no_object_is_named(tmp_path, text):
    path = write(tmp_path, 1)
    (path / "policy.json").write_text(text)
    with pytest.raises(
        CheckpointError, match=r"policy\.json: (input should be an object|invalid JSON)"
    ):
        Checkpoint.open(path).policy()


def test_a_flipped_bit_in_any_file_is_named(tmp_path):
    write(tmp_path, 1)
    newest = write(tmp_path, 2)
    names = [p.relative_to(newest) for p in newest.rglob("*") if p.is_file()]
    assert len(names) == 7
    for name in names:
        whole = (newest / name).read_bytes()
        for at in {0, len(whole) // 2, len(whole) - 2 if len(whole) > 1 else 0}:
            flipped = bytearray(whole)
            flipped[at] ^= 1
            (newest / name).write_bytes(flipped)
            with pytest.raises(CheckpointError) as caught:
                Checkpoint.open(newest).verify()
            message = str(caught.value)
            assert f"{name} is damaged" in message or "fluxvla-checkpoint" in message
            assert str(name) in message
            before = f"{tmp_path}/checkpoints/step-000000001"
            assert f"the one before it is undamaged: {before}" in message
        (newest / name).write_bytes(whole)
    Checkpoint.open(newest).verify()


def test_a_lost_and_a_cut_file_are_named(tmp_path):
    path = write(tmp_path, 1)
    (path / "policy.json").unlink()
    with pytest.raises(CheckpointError, match=r"policy\.json is missing from the checkpoint"):
        Checkpoint.open(path).verify()
    other = write(tmp_path, 2)
    (other / "model.safetensors").write_bytes(b"short")
    with pytest.raises(CheckpointError, match=r"model\.safetensors is damaged: 5 bytes instead of"):
        Checkpoint.open(other).verify()


def test_a_file_that_cannot_be_read_is_named_and_passed_over(tmp_path, monkeypatch):
    """A failing disk (EIO) or another user's file must not end ``--resume auto``."""
    first, second = write(tmp_path, 1), write(tmp_path, 2)
    read = checkpoint.hash_file

    def failing(path):
        if path == second / "model.safetensors":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return read(path)

    monkeypatch.setattr(checkpoint, "hash_file", failing)
    found, (refused,) = newest_undamaged(tmp_path)
    assert found.path == first
    assert refused.what == "model.safetensors cannot be read: Input/output error"
    with pytest.raises(CheckpointError) as caught:
        Checkpoint.open(second).verify()
    assert str(caught.value) == (
        f"{second}: model.safetensors cannot be read: Input/output error\n"
        "  likely cause: its permissions, or a disk or mount that fails\n"
        f"  next: the one before it is undamaged: {first}"
    )


def test_a_folder_that_cannot_be_looked_into_is_passed_over(tmp_path, monkeypatch):
    first, second = write(tmp_path, 1), write(tmp_path, 2)

    def denied(operation):
        def act(path, *arguments, **named):
            if Path(path).parent == second:
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            return operation(path, *arguments, **named)

        return act

    monkeypatch.setattr(Path, "is_file", denied(Path.is_file))
    monkeypatch.setattr(os, "open", denied(os.open))
    found, (refused,) = newest_undamaged(tmp_path)
    assert found.path == first
    assert "manifest.json cannot be read" in refused.what


def test_a_damaged_one_without_a_whole_one_before_offers_nothing(tmp_path):
    first, second = write(tmp_path, 1), write(tmp_path, 2)
    (first / "manifest.json").write_text("{")
    (second / "policy.json").unlink()
    with pytest.raises(CheckpointError) as caught:
        Checkpoint.open(second).verify()
    assert caught.value.next is None


def test_another_format_is_told_from_damage(tmp_path):
    path = write(tmp_path, 1)
    body = json.loads((path / "manifest.json").read_text())
    body["format"] = "fluxvla-checkpoint-9"
    (path / "manifest.json").write_text(json.dumps(body))
    with pytest.raises(CheckpointError, match="has format 'fluxvla-checkpoint-9'; this version"):
        read_manifest(path)


def test_opening_what_is_no_checkpoint(tmp_path):
    write(tmp_path, 5)
    with pytest.raises(CheckpointError) as caught:
        Checkpoint.open(tmp_path / "checkpoints" / "step-000000006")
    assert str(caught.value) == (
        f"there is no checkpoint at {tmp_path}/checkpoints/step-000000006\n"
        f"  next: the newest one there is {tmp_path}/checkpoints/step-000000005"
    )
    (tmp_path / "old.pt").write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"old\.pt is a file; a checkpoint is a folder like"):
        Checkpoint.open(tmp_path / "old.pt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match=r"manifest\.json is missing, so this is not a check"):
        Checkpoint.open(tmp_path / "empty")


def test_a_work_dir_stands_for_its_newest(tmp_path):
    for step in (9, 100, 20):
        write(tmp_path, step)
    assert Checkpoint.open(tmp_path).step == 100
    assert Checkpoint.open(tmp_path / "checkpoints").step == 100
    assert latest(tmp_path).step == 100
    assert [p.name[-3:] for p in folders(tmp_path)] == ["009", "020", "100"]


def test_names_that_are_no_checkpoints_are_passed_over(tmp_path):
    path = write(tmp_path, 1)
    for name in ("step-000000009.partial", "step-000000008.removing", "step-5.set-aside", "notes"):
        shutil.copytree(path, path.with_name(name))
    (path.parent / "step-000000007").mkdir()
    assert folders(tmp_path) == [path]
    assert latest(tmp_path / "nowhere") is None


def test_newest_whole_says_what_it_passed_over(tmp_path):
    write(tmp_path, 1)
    (write(tmp_path, 2) / "policy.json").unlink()
    (write(tmp_path, 3) / "manifest.json").write_text("{}")
    found, refused = newest_undamaged(tmp_path)
    assert found.step == 1
    assert [error.what.split(":")[0] for error in refused] == [
        "manifest.json is damaged",
        "policy.json is missing from the checkpoint",
    ]
    assert newest_undamaged(tmp_path / "nowhere") == (None, [])


def relisted(path, name):
    """The checkpoint at ``path`` lists ``name`` too, with a sum of its own that fits."""
    found = read_manifest(path)
    manifest = Manifest(1, 0, {**found.files, name: FileEntry(3, "0" * 64)}).to_bytes()
    (path / "manifest.json").write_bytes(manifest)


@pytest.mark.parametrize("name", ["/etc/passwd", "../outside", "a/../../outside", "", "a//b", "."])
def test_files_outside_the_folder_are_refused_by_name(tmp_path, name):
    path = write(tmp_path, 1)
    relisted(path, name)
    with pytest.raises(CheckpointError, match="not a path inside") as caught:
        Checkpoint.open(path)
    assert repr(name) in str(caught.value)


def test_links_out_of_the_folder_are_refused_by_name(tmp_path):
    path = write(tmp_path, 1)
    secret = tmp_path / "secret"
    secret.write_text("{}")
    policy = path / "policy.json"
    policy.unlink()
    policy.symlink_to(secret)
    with pytest.raises(CheckpointError, match=r"'policy\.json', which leads out of the checkpoint"):
        Checkpoint.open(path)
    policy.unlink()
    policy.symlink_to("embodiment.json")  # within the folder
    Checkpoint.open(path)
    moved = tmp_path / "best"
    moved.symlink_to(path)
    Checkpoint.open(moved)


def test_a_manifest_that_is_no_file_is_refused_at_once(tmp_path):
    path = write(tmp_path, 1)
    manifest = path / "manifest.json"
    manifest.unlink()
    os.mkfifo(manifest)
    with pytest.raises(CheckpointError, match=r"manifest\.json is not a regular file"):
        Checkpoint.open(path)
    manifest.unlink()
    manifest.symlink_to("/dev/zero")
    with pytest.raises(CheckpointError, match=r"manifest\.json is not a regular file"):
        Checkpoint.open(path)


@pytest.mark.parametrize(
    ("key", "value"), [("step", "Infinity"), ("step", "-1"), ("epoch", '"3"'), ("files", "[1]")]
)
def test_wrong_types_in_the_manifest_are_named(tmp_path, key, value):
    path = write(tmp_path, 1)
    body = json.loads((path / "manifest.json").read_text())
    text = json.dumps(body | {key: "HERE"}).replace('"HERE"', value)
    (path / "manifest.json").write_text(text)
    with pytest.raises(CheckpointError, match=f"manifest.json is damaged: {key}"):
        Checkpoint.open(path)
