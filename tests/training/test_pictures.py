"""A run whose images are normalised where it computes is the run whose workers do it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from fluxvla_core import build_dataset_from_cfg
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.loader import DictCollator, make_loader
from fluxvla_core.data.mixture import DistributedRepeatingDataset
from fluxvla_core.data.sampler import EpochSampler
from fluxvla_core.data.transforms.images import SCALE
from fluxvla_core.data.writer import LeRobotWriter
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from fluxvla_core.testing.training import differences, unflushed
from fluxvla_core.training import batches

pytest.importorskip("av")
pytest.importorskip("pyarrow")

KEYS = ["images", "states", "actions", "noise", "time", "sample_ids"]
META = ["img_masks", "action_masks", "task_description", "timestamp", "info"]
NORMALIZE = {"type": "NormalizeImages", "means": [120.5] * 3, "stds": [57.27539062] * 3}
CPU, GPU = torch.device("cpu"), torch.device("cuda")


@VLAS.register_module()
class Seeing(nn.Module):
    """Looks at every pixel, with dropout."""

    def __init__(self):
        super().__init__()
        self.see = nn.Conv2d(6, 4, 3, stride=3)
        self.act = nn.Linear(4 + 2, 2 * 2)
        self.dropout = nn.Dropout(0.2)

    def forward(self, images, states, actions, noise, time):
        assert images.dtype == torch.float32
        x = torch.relu(self.see(images)).mean((2, 3))
        found = self.act(self.dropout(torch.cat([x, states], 1))).unflatten(1, (2, 2))
        return {"loss": (found - actions - 0.1 * time[:, :1, None] * noise[:, 0]).square().mean()}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """Two datasets of one robot, with two cameras."""
    base = tmp_path_factory.mktemp("data")
    joints = tuple(Joint(name, "rad", -3.0, 3.0, 2.0, 4.0) for name in ("a", "b"))
    cameras = (Camera("top", 32, 32), Camera("wrist", 32, 32))
    spec = EmbodimentSpec("arm", joints, cameras, 10.0)
    for number in range(2):
        rng = np.random.default_rng(number)
        with LeRobotWriter(base / str(number), 10, spec) as writer:
            for _ in range(9):
                shades = rng.integers(0, 256, (2, 4, 4, 3), np.uint8).repeat(8, 1).repeat(8, 2)
                images = dict(zip(("top", "wrist"), shades, strict=True))
                state, action = rng.normal(size=(2, 2)).astype(np.float32)
                writer.add_frame(images, state, action, "do it")
            writer.save_episode()
    return [base / str(number) for number in range(2)]


def table(root, *normalize):
    return {
        "type": "ParquetDataset",
        "data_root_path": str(root),
        "img_keys": ["top", "wrist"],
        "action_window_size": 2,
        "cache_frames": True,
        "transforms": [
            {"type": "RandomShiftImages", "pixels": 2},
            {"type": "ResizeImages", "height": 12, "width": 12},
            *(normalize or [NORMALIZE]),
            {"type": "NormalizeStatesAndActions"},
            {"type": "SampleFlowNoise"},
        ],
    }


def mixture(roots):
    other = table(roots[1], {"type": "SimpleNormalizeImages"})
    return {"type": "DistributedRepeatingDataset", "datasets": [table(roots[0]), other]}


def train(work_dir, dataset, workers, steps=6, resume=None, val=None):
    config = {
        "model": {"type": "Seeing"},
        "train_dataloader": {"per_device_batch_size": 4, "per_device_num_workers": workers},
        "runner": {
            "type": "OneProcessRunner",
            "learning_rate": 1e-2,
            "max_steps": steps,
            "save_iter_interval": 3,
            "max_keep_ckpts": 0,
            "peak_tflops": 1.0,
            "collator": {"type": "DictCollator", "keys": KEYS, "meta_keys": META},
        },
    }
    if val is not None:
        config["val_dataloader"] = {"dataset": val}
    said = Said()
    context = RunContext(
        config=config, section="runner", work_dir=work_dir, resume=resume, reporter=said
    )
    built = build_dataset_from_cfg(dataset)
    with unflushed():
        runner = build_runner_from_cfg(config["runner"], context)
        runner.run_setup(len(built))
        runner.run(built)
    assert said.warnings == []
    assert runner.flops.per_batch > 0
    assert built[0]["images"].dtype == np.float32, "the dataset that was given is as it was"


class Said(SilentReporter):
    def __init__(self):
        self.warnings = []

    def warn(self, text):
        self.warnings.append(text)


@pytest.fixture
def leave(monkeypatch):
    """Once called, runs leave images to the device; gives the dtypes that arrive there."""
    arrived = []

    def spy(batch, known=batches.normalized):
        arrived.append(batch["images"].dtype)
        return known(batch)

    def ask():
        monkeypatch.setattr(batches, "on_device", lambda device: True)
        monkeypatch.setattr(batches, "normalized", spy)
        return arrived

    return ask


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("kind", ["one", "mixture"])
def test_nothing_changes_in_a_run_but_where_images_are_normalised(
    roots, tmp_path, leave, kind, workers
):
    dataset = table(roots[0]) if kind == "one" else mixture(roots)
    val = dataset if workers == 0 else None
    train(tmp_path / "here", dataset, workers, val=val)
    arrived = leave()
    train(tmp_path / "left", dataset, workers, val=val)
    assert set(arrived) == {torch.uint8}
    assert len(arrived) > 6
    assert differences(tmp_path / "here", tmp_path / "left") == []


def test_a_run_goes_on_the_other_way_bit_for_bit(roots, tmp_path, leave):
    dataset = mixture(roots)
    train(tmp_path / "here", dataset, 0)
    train(tmp_path / "left", dataset, 0, steps=3)
    arrived = leave()
    train(tmp_path / "left", dataset, 0, resume="auto")
    assert set(arrived) == {torch.uint8}
    found = differences(tmp_path / "here", tmp_path / "left")
    assert found == ["step-000000003/config.resolved.json"], "of fewer steps"


def test_what_is_left_travels_as_a_quarter_of_the_bytes(roots):
    collator = DictCollator(KEYS, META)
    dataset = build_dataset_from_cfg(table(roots[0]))
    plain = batches.loader_source(dataset, collator, CPU)
    left = batches.loader_source(dataset, collator, GPU)
    assert plain is dataset
    assert isinstance(left, ParquetDataset)
    assert left.get_sample(0, 0)["images"].nbytes * 4 == plain.get_sample(0, 0)["images"].nbytes
    assert dataset.get_sample(0, 0)["images"].dtype == np.float32


def test_a_worker_that_does_not_inherit_reads_it_too(roots):
    """Where processes are not forked, which is Python 3.14's default, a dataset is sent to them."""
    left = batches.loader_source(
        build_dataset_from_cfg(mixture(roots)), DictCollator(KEYS, META), GPU
    )
    keys = [next(iter(EpochSampler(len(left), 4).batches(0)))]
    loader = make_loader(
        left, DictCollator(KEYS, META), keys, 1, multiprocessing_context="forkserver"
    )
    (batch,) = loader
    assert batch["images"].dtype == torch.uint8
    assert batch[SCALE].shape == (4, 4, 6)


def test_a_mixture_leaves_all_or_nothing(roots):
    collator = DictCollator(KEYS, META)
    whole = build_dataset_from_cfg(mixture(roots))
    left = batches.loader_source(whole, collator, GPU)
    assert isinstance(left, DistributedRepeatingDataset)
    assert {left[i]["images"].dtype for i in range(len(left))} == {np.dtype(np.uint8)}
    assert {whole[i]["images"].dtype for i in range(len(whole))} == {np.dtype(np.float32)}
    strange = table(roots[1], NORMALIZE, lambda sample: sample)
    half = DistributedRepeatingDataset([table(roots[0]), strange])
    assert batches.loader_source(half, collator, GPU) is half


class Cropping(DictCollator):
    """Somebody's, that looks at images."""

    def __call__(self, samples):
        return super().__call__([{**s, "images": s["images"][..., 1:]} for s in samples])


class Renamed(DictCollator):
    """The same, under another name."""


@pytest.mark.parametrize(
    ("collator", "leaves"),
    [
        (DictCollator(KEYS, META), True),
        (Renamed(KEYS, META), True),
        (Cropping(KEYS, META), False),
        (DictCollator(["states"], ["images"]), False),
        (lambda samples: samples, False),
    ],
)
def test_only_the_cores_collator_is_given_what_is_left(roots, collator, leaves):
    dataset = build_dataset_from_cfg(table(roots[0]))
    assert (batches.loader_source(dataset, collator, GPU) is not dataset) is leaves


def test_a_dataset_that_knows_nothing_of_it_is_read_as_it_is():
    dataset = [{"images": np.zeros((3, 2, 2), np.float32)}]
    assert batches.loader_source(dataset, DictCollator(KEYS), GPU) is dataset
