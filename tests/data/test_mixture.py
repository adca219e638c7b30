"""Mixtures: who is seen how often, statistics of all together, and upstream's flaws D1 to D3."""

from __future__ import annotations

import pickle
from collections import Counter
from itertools import islice

import numpy as np
import pytest
import torch

from fluxvla_core import build_dataset_from_cfg
from fluxvla_core.build import RunContext
from fluxvla_core.data.dataset import ParquetDataset
from fluxvla_core.data.loader import DictCollator, make_loader
from fluxvla_core.data.mixture import DistributedRepeatingDataset, first_dataset, shares
from fluxvla_core.data.sampler import SampleKey, StepPlan, StepSampler
from fluxvla_core.errors import ConfigError, DataError, SpecMismatch
from fluxvla_core.training.state import seeds_of

NOISE = {"type": "SampleFlowNoise"}
NORMALISE = {"type": "NormalizeStatesAndActions"}
KEYS = ("states", "actions", "action_masks", "noise", "time", "sample_ids")
META = ("task_description", "info", "timestamp")


@pytest.fixture(scope="module")
def others(tmp_path_factory, recorder, take):
    """Ten frames of the same robot, far from those of ``shared``, and five of another robot."""
    folder = tmp_path_factory.mktemp("mixture")
    far = take(5, 10, "wave")
    far.state[:], far.action[:] = far.state * 3 + 50, far.action - 20
    return recorder(folder / "more", [far]), far


@pytest.fixture(scope="module")
def left(tmp_path_factory, recorder, take, spec):
    robot = spec(name="left", joints=spec().joints[::-1])
    return recorder(tmp_path_factory.mktemp("left") / "left", [take(8, 5)], embodiment=robot)


def table(root, **options):
    transforms = options.pop("transforms", [NOISE])
    base = {"type": "ParquetDataset", "data_root_path": str(root), "img_keys": []}
    return {**base, "action_window_size": 4, "transforms": transforms, **options}


def mixture(*tables, **options):
    return DistributedRepeatingDataset(list(tables), **options)


def drawn(dataset, epochs):
    """How often each sample of each dataset is shown in ``epochs``."""
    return Counter(
        (part, key.index)
        for epoch in epochs
        for i in range(len(dataset))
        for part, key in [dataset.place(SampleKey(epoch, i))]
    )


def test_without_weights_every_sample_is_seen_once_an_epoch(shared, others):
    dataset = build_dataset_from_cfg(
        {"type": "DistributedRepeatingDataset", "datasets": [table(shared), table(others[0])]}
    )
    assert len(dataset) == 38
    ids = [int(dataset[i]["sample_ids"]) for i in range(38)]
    assert ids == list(range(38))
    for i in (0, 27):
        np.testing.assert_array_equal(dataset[i]["actions"], dataset.datasets[0][i]["actions"])
    np.testing.assert_array_equal(dataset[28]["states"], others[1].state[0])
    assert dataset[37]["info"]["dataset"] == str(others[0])
    assert dataset.tasks == ("hold the cube", "hand the cube over", "wave")
    assert (dataset.fps, dataset.action_window_size) == (10, 4)
    assert dataset.embodiment.name == "arm"
    assert dataset.pipeline is dataset.datasets[0].pipeline
    for index in (-1, 38):
        with pytest.raises(IndexError, match=f"sample {index} of 38"):
            dataset[index]


def test_weights_are_kept_exactly_and_rounds_leave_nobody_out(shared, others):
    dataset = mixture(table(shared), table(others[0]), weights=[1, 3], samples_per_epoch=40)
    for epoch in range(3):
        assert Counter(part for part, _ in drawn(dataset, [epoch]).elements()) == {0: 10, 1: 30}
    assert set(drawn(dataset, [0]).values()) == {1, 3}
    # 14 epochs are 5 rounds through 28 samples, and 42 through 10.
    seen = drawn(dataset, range(14))
    assert {count for (part, _), count in seen.items() if part == 0} == {5}
    assert {count for (part, _), count in seen.items() if part == 1} == {42}
    first = [key.index for part, key in map(dataset.place, keys(0)) if part == 0]
    assert sorted(first) != first
    assert first != [key.index for part, key in map(dataset.place, keys(1)) if part == 0]


def keys(epoch):
    return [SampleKey(epoch, i) for i in range(40)]


def test_a_sample_is_a_function_of_seed_epoch_and_index(shared, others):
    def make(seed=1):
        tables = (table(shared), table(others[0]))
        return mixture(*tables, weights=[1, 3], samples_per_epoch=40, seed=seed)

    one, two = make(), make()
    list(two)
    for epoch, i in ((0, 3), (5, 9), (2, 39), (0, 3)):
        a, b = one.get_sample(i, epoch), two.get_sample(i, epoch)
        for key in KEYS:
            np.testing.assert_array_equal(a[key], b[key])
    assert drawn(make(2), [0]) != drawn(one, [0])
    copy = pickle.loads(pickle.dumps(one))  # noqa: S301
    np.testing.assert_array_equal(copy[7]["noise"], one[7]["noise"])
    together = one.get_samples(keys(1)[::-1])
    for i, sample in zip(range(39, -1, -1), together, strict=True):
        np.testing.assert_array_equal(sample["noise"], one.get_sample(i, 1)["noise"])


def test_a_runs_seed_reaches_those_that_have_none(shared, others):
    def make(seed=None):
        tables = (table(shared), {**table(others[0]), "seed": 5})
        return mixture(*tables, weights=[1, 3], samples_per_epoch=40, seed=seed)

    given, own = make(), make(1)
    before = drawn(given, [0])
    given.use_seed(7)
    own.use_seed(7)
    assert seeds_of(given) == [7, 7, 5]
    assert seeds_of(own) == [1, 7, 5]
    assert drawn(given, [0]) == drawn(make(7), [0]) != before
    assert drawn(own, [0]) == drawn(make(1), [0])


def test_no_two_samples_draw_the_same_noise(shared, others):
    """Not repeated within an epoch, not of one number in two datasets with the same seed."""
    dataset = mixture(table(shared), table(others[0]), weights=[1, 3], samples_per_epoch=40)
    noise = [s["noise"].tobytes() for e in range(3) for s in dataset.get_samples(keys(e))]
    assert len(set(noise)) == 120


@pytest.mark.parametrize("options", [{}, {"relative_actions": True, "per_step_statistics": True}])
def test_statistics_of_several_are_those_of_all_frames(shared, others, options):
    """D1: upstream's merged deviations were sqrt(D) too small; here D is 3, the ratio 1."""
    dataset = mixture(table(shared, **options), table(others[0], **options), weights=[1, 9])
    both = table([str(shared), str(others[0])], **options)
    whole = build_dataset_from_cfg({**both, "data_root_path": [str(shared), str(others[0])]})
    assert dataset.statistics == whole.statistics
    found = dataset.statistics["private"]["proprio"]
    states = np.concatenate([d.loaded[0].states for d in dataset.datasets]).astype(float)
    np.testing.assert_allclose(found["std"], states.std(0), rtol=1e-12)
    np.testing.assert_array_equal(found["q99"], np.quantile(states, 0.99, axis=0))
    assert found["count"] == [38]


def test_samples_are_normalised_by_what_they_share(shared, others):
    transforms = [NORMALISE]
    dataset = mixture(*(table(r, transforms=transforms) for r in (shared, others[0])))
    states = np.stack([sample["states"] for sample in dataset])
    np.testing.assert_allclose(states.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(states.std(0), 1, atol=1e-5)
    assert abs(states[28:].mean()) > 1


def test_statistics_are_computed_once_for_all_that_share_them(shared, others, monkeypatch):
    from fluxvla_core.data import dataset as parquet_dataset

    computed = []
    column_statistics = parquet_dataset.column_statistics
    monkeypatch.setattr(
        parquet_dataset,
        "column_statistics",
        lambda rows: computed.append(len(rows)) or column_statistics(rows),
    )
    dataset = mixture(table(shared), table(others[0]))
    assert dataset.statistics["private"]["proprio"]["count"] == [38]
    assert computed == [38, 38], "of states and of actions"


def test_what_several_doubt_of_shared_statistics_is_said_once(tmp_path, recorder, take):
    roots = []
    for key in (0, 1):
        still = take(key, 6)
        still.state[:, 1] = 0.5
        roots.append(recorder(tmp_path / str(key), [still]))
    (said,) = mixture(*(table(root, transforms=[NORMALISE]) for root in roots)).warnings()
    assert "state elbow" in said


def test_another_robot_has_statistics_of_its_own(shared, others, left):
    groups = {"right": [table(shared), table(others[0])], "left": table(left)}
    dataset = DistributedRepeatingDataset(groups)
    alone = ParquetDataset(str(left), [], []).statistics["private"]["proprio"]
    assert dataset.statistics["left"]["proprio"] == alone
    assert dataset.statistics["right"]["proprio"]["count"] == [38]
    assert dataset.embodiment.name == "arm"
    with pytest.raises(SpecMismatch, match="joints and their order"):
        mixture(table(shared), table(left))


def test_datasets_that_take_actions_differently_share_no_statistics(shared, others):
    with pytest.raises(ConfigError) as caught:
        mixture(table(shared), table(others[0], relative_actions=True))
    assert "statistics 'private'" in str(caught.value)
    assert "take actions differently: relative_actions None / [True, True, False]" in str(
        caught.value
    )
    assert "give one another statistic_name" in str(caught.value)
    mixture(table(shared), table(others[0], relative_actions=True, statistic_name="b"))


def test_robots_that_configs_name_are_compared_too(shared, tmp_path, recorder, take, spec):
    root = recorder(tmp_path / "quiet", [take(0, 4)])
    (root / "meta/fluxvla_embodiment.json").unlink()
    other = spec(joints=spec().joints[::-1]).to_dict()
    with pytest.raises(SpecMismatch):
        mixture(table(shared), table(root, embodiment=other))
    info = root / "meta/info.json"
    info.write_text(info.read_text().replace('"fps": 10', '"fps": 20'))
    with pytest.raises(DataError, match=r"do not go together: fps: 10\.0 / 20\.0"):
        mixture(table(shared), table(root))


class Foreign:
    """Another's dataset: the contract and nothing more."""

    fps, embodiment = 5.0, None

    def __init__(self, name="private"):
        self.statistics = {name: {"action": {"mean": [0.0]}}}
        self.context = None

    def __len__(self):
        return 3

    def get_sample(self, index, epoch):
        return {"x": (index, epoch)}


def test_datasets_of_others(shared):
    with pytest.raises(ConfigError, match="are computed from their rows, and Foreign shows none"):
        mixture(table(shared), Foreign())
    dataset = mixture(Foreign("theirs"), table(shared))
    assert dataset.get_sample(2, 1) == {"x": (2, 2)}
    assert set(dataset.statistics) == {"theirs", "private"}
    assert (dataset.fps, dataset.pipeline, dataset.action_window_size) == (5.0, None, None)
    dataset.prepare()


def test_the_context_is_handed_on(shared, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "fluxvla_core.data.mixture.build_dataset_from_cfg",
        lambda cfg, context, **defaults: seen.append((context, defaults)) or Foreign(cfg),
    )
    context = RunContext({}, "runner", tmp_path)
    DistributedRepeatingDataset({"a": "a", "b": ["b"]}, context=context)
    assert seen == [(context, {"statistic_name": "a"}), (context, {"statistic_name": "b"})]


def test_every_dataset_prepares_and_says_so(shared, others):
    reported = []

    class Reporter:
        def progress(self, name, done, total, **fields):
            reported.append((name, done, total))

    cached = {"img_keys": ["wrist"], "cache_frames": True}
    dataset = mixture(table(shared, **cached), table(others[0], **cached))
    dataset.prepare(Reporter())
    assert ("decode frames", 28, 28) in reported
    assert reported[-1] == ("decode frames", 10, 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": [1.0]}, "1 weights for 2 datasets"),
        ({"weights": [1.0, 0.0]}, r"weights must be positive, got \[1\.0, 0\.0\]"),
        ({"weights": [1.0, float("nan")]}, "weights must be positive"),
        ({"weights": [1.0, 99.0], "samples_per_epoch": 10}, "of 10 samples, dataset 0 gets none"),
    ],
)
def test_weights_that_make_no_sense(shared, others, options, message):
    with pytest.raises(ConfigError, match=message):
        mixture(table(shared), table(others[0]), **options)


def test_no_dataset():
    for empty in ([], {}):
        with pytest.raises(ConfigError, match="datasets names no dataset"):
            DistributedRepeatingDataset(empty)


@pytest.mark.parametrize("total", [7, 1000, 12345])
def test_shares_are_exact_in_sum_and_near_in_each(total):
    weights = np.random.default_rng(total).uniform(1, 3, 5)
    given = shares(total, weights, 5)
    assert given.sum() == total
    assert (abs(given - weights / weights.sum() * total) < 1).all()


def batches(shared, others, count, workers=0, rank=0, world=1):
    tables = [table(root, transforms=[NORMALISE, NOISE]) for root in (shared, others[0])]
    dataset = mixture(*tables, weights=[1, 1], samples_per_epoch=20)
    sampler = StepSampler(StepPlan(len(dataset), 4, world=world), rank)
    return list(islice(make_loader(dataset, DictCollator(KEYS, META), sampler, workers), count))


def test_workers_change_nothing(shared, others):
    for one, two in zip(batches(shared, others, 7), batches(shared, others, 7, 2), strict=True):
        for key in KEYS:
            assert torch.equal(one[key], two[key])


def test_epochs_differ_without_workers_too(shared, others):
    """D2: upstream's order was the same in every epoch when nothing loaded beside."""
    ids = [batch["sample_ids"].tolist() for batch in batches(shared, others, 10)]
    assert ids[:5] != ids[5:]
    noise = [batch["noise"].flatten().tolist() for batch in batches(shared, others, 10)]
    assert not {x for n in noise[:5] for x in n} & {x for n in noise[5:] for x in n}


def test_a_rank_is_a_rank_of_all_nodes(shared, others, monkeypatch):
    """D3: upstream took LOCAL_RANK for the rank, so the nodes saw the same; and needed torchrun."""
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    alone = batches(shared, others, 2)
    monkeypatch.setenv("LOCAL_RANK", "0")
    nodes = [batches(shared, others, 1, rank=rank, world=2)[0] for rank in range(2)]
    for one, two in zip(alone, nodes, strict=True):
        for key in KEYS:
            assert torch.equal(one[key], two[key])


def test_the_first_dataset_of_a_table():
    plain = {"type": "ParquetDataset", "img_keys": ["top"]}
    assert first_dataset(plain) == plain
    assert first_dataset({"type": "D", "datasets": plain}) == plain
    assert first_dataset({"type": "D", "datasets": [plain, {}]}) == plain
    assert first_dataset({"type": "D", "datasets": {"arm": [plain], "b": {}}}) == {
        **plain,
        "statistic_name": "arm",
    }


def test_its_parts_have_names_and_as_many_ids_as_samples(shared, others, left):
    more, _ = others
    again, other = (table(r, statistic_name=n) for r, n in ((more, "again"), (left, "left")))
    several = mixture(table(shared), table(more), again, other)
    sizes = several.lengths.tolist()
    assert list(several.parts) == [shared.name, "more-1", "more-2", "left"]
    assert list(several.parts.values()) == sizes
    ids = sorted(int(several[i]["sample_ids"]) for i in range(len(several)))
    assert ids == list(range(sum(sizes)))


def test_parts_of_datasets_that_have_no_folder():
    class Plain:
        statistic_name = "plain"
        statistics = {"plain": {}}  # noqa: RUF012

        def __len__(self):
            return 3

    class Bare(Plain):
        statistic_name = "bare"
        statistics = {"bare": {}}  # noqa: RUF012

    assert mixture(Plain(), Bare()).parts == {"plain": 3, "bare": 3}
