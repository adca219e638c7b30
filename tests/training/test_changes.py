"""What is different between a checkpoint's run and the one that goes on."""

from __future__ import annotations

import pytest

from fluxvla_core.training.resuming import changed_settings, changed_statistics


def tree(**dataset):
    table = {"type": "ParquetDataset", "data_root_path": "a", "cache_frames": False, **dataset}
    return {
        "model": {"type": "CompactVLA", "head": {"width": 8, "model_path": "m"}},
        "train_dataloader": {"per_device_num_workers": 2, "dataset": table},
        "train": {"type": "DDPTrainRunner", "max_steps": 10, "metric": {"type": "VLAMetric"}},
        "eval": {"type": "AlohaSimEvalRunner", "episodes": 2},
    }


def test_paths_workers_logging_saving_and_length_may_change():
    ours = tree(data_root_path="/elsewhere", cache_frames=True)
    ours["model"]["head"]["model_path"] = "/elsewhere/m"
    ours["train_dataloader"]["per_device_num_workers"] = 0
    ours["train"] |= {"max_steps": 20, "max_keep_ckpts": 1, "metric": {"type": "Mine", "n": 3}}
    ours["eval"]["episodes"] = 50
    assert changed_settings(tree(), ours, "train") == {}


@pytest.mark.parametrize(
    "schedule",
    [
        {"lr_scheduler_type": "linear-warmup+cosine-decay"},
        {"lr_scheduler_type": "step-based", "lr_schedule": {"0": 1e-4}},
        {"warmup_ratio": 0.1},
    ],
)
def test_the_length_is_told_where_the_rate_follows_from_it(schedule):
    before, now = tree(), tree()
    before["train"] |= schedule
    now["train"] |= {**schedule, "max_steps": 20}
    assert changed_settings(before, now, "train") == {"train.max_steps": ("10", "20")}


def test_another_validation_set_is_told():
    """The best checkpoint, and when to stop, follow from it."""
    before, now = tree(), tree()
    before["val_dataloader"] = {"dataset": {"type": "ParquetDataset", "episodes": [1, 2]}}
    now["val_dataloader"] = {"dataset": {"type": "ParquetDataset", "episodes": [1, 3]}}
    assert changed_settings(before, now, "train") == {
        "val_dataloader.dataset.episodes": ("[1, 2]", "[1, 3]")
    }
    assert list(changed_settings(tree(), now, "train")) == [
        "val_dataloader.dataset.type",
        "val_dataloader.dataset.episodes",
    ]
    assert changed_settings(tree(), {**tree(), "val_dataloader": None}, "train") == {}


def test_a_table_in_a_list_is_compared_key_by_key():
    before = tree(transforms=[{"type": "ResizeImages", "height": 8}, {"type": "Noise", "std": 0.1}])
    now = tree(transforms=[{"type": "ResizeImages", "height": 8}, {"type": "Noise", "std": 0.2}])
    now["model"]["head"] = None
    assert changed_settings(before, now, "train") == {
        "model.head.width": ("8", "not set"),
        "model.head": ("not set", "null"),
        "train_dataloader.dataset.transforms.1.std": ("0.1", "0.2"),
    }


def test_an_object_made_anew_is_the_same():
    class Collator:
        pass

    trees = [{**tree(), "train": {"collator": Collator()}} for _ in range(2)]
    assert changed_settings(*trees, "train") == {}


def statistics(mean=0.5, **more):
    return {"private": {"action": {"mean": [mean, 2.0], "count": 9, **more}}}


def test_statistics_of_another_machine_are_the_same_but_for_rounding():
    assert changed_statistics(statistics(), statistics(0.5 + 1e-9)) == []
    assert changed_statistics(statistics(1e-17), statistics(-1e-17)) == []
    assert changed_statistics(statistics(), statistics(0.501)) == ["private.action.mean"]


def test_statistics_that_only_one_has_differ():
    assert changed_statistics(statistics(), statistics(relative=[True, False])) == [
        "private.action.relative"
    ]
    assert changed_statistics(statistics(), {"left": {}}) == ["private", "left"]
    nested = [statistics(std=[[1.0, 2.0]] * rows) for rows in (2, 3)]
    assert changed_statistics(*nested) == ["private.action.std"]
