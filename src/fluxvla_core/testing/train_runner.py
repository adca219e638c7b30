"""Conformance tests for train runners, which a plugin inherits.

    from fluxvla_core.testing.train_runner import TrainRunnerConformance

    class TestMyTrainRunner(TrainRunnerConformance):
        entry_point = "MyTrainRunner"
        ranks = 2

pytest collects the inherited tests. They start real processes on the loopback, kill some of them,
and compare the resulting files bit for bit.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import torch

from fluxvla_core.checkpoints.checkpoint import MODEL, Checkpoint, folders
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing._conformance import Conformance
from fluxvla_core.testing.training import (
    SCALARS,
    checkpoint_differences,
    differences,
    run_ranks,
    tiny_config,
    train,
    train_all,
)

LENGTH: dict[str, dict[str, Any]] = {
    "steps": {"max_steps": 9, "save_iter_interval": 4},
    "epochs": {"max_epochs": 3, "save_iter_interval": 3},
}


class TrainRunnerConformance(Conformance):
    """Inherit, set ``entry_point``, and run pytest."""

    registry = "runners"
    entry_point: ClassVar[str]
    """The runner's ``type`` in a config."""
    ranks: ClassVar[int] = 2
    """Processes to train on."""
    settings: ClassVar[Mapping[str, Any]] = {}
    """Further settings of the runner."""
    modules: ClassVar[Mapping[str, Any]] = {}
    """Settings of ``TinyVLA`` in all tests."""
    reference: ClassVar[str] = "OneProcessRunner"
    """The runner that trains the same on one process: another one for a strategy that changes the
    gradients or the optimizer, which may be its own."""
    scalars: ClassVar[tuple[str, ...]] = SCALARS
    """Which parameters without dimensions a model may have; it has to refuse the others."""

    def config(
        self, batch: int = 3, dropout: float = 0.1, centred: bool = True, **settings: Any
    ) -> dict[str, Any]:
        """A config with everything on that has a state: schedule, averages, dropout, buffers.

        The model has parameters of every kind: of an odd number of elements, of one, without
        dimensions, tied, and frozen.
        """
        table = {
            "type": self.entry_point,
            "ema_decay": 0.9,
            "weight_decay": 0.1,
            "lr_scheduler_type": "linear-warmup+cosine-decay",
            "warmup_ratio": 0.2,
            "log_iter_interval": 3,
            "max_keep_ckpts": 0,
            **self.settings,
            **settings,
        }
        model = {
            "width": 7,
            "dropout": dropout,
            "centred": centred,
            "batch_norm": centred,
            "assorted": True,
            "scalar": self.scalars[0] if self.scalars else None,
            **self.modules,
        }
        return tiny_config(table, batch, **model)

    def start(self, *runs: Mapping[str, Any]) -> list[int | None]:
        """The exit codes of ``ranks`` processes that do ``runs``."""
        return run_ranks(self.ranks, train_all, *runs)

    def test_a_killed_run_goes_on_bit_for_bit(self, tmp_path: Path) -> None:
        """Step- and epoch-based, one and two batches a step; the dying of one resumes another."""
        wholes: list[dict[str, Any]] = []
        cuts: list[dict[str, Any]] = []
        gone_on: list[dict[str, Any]] = []
        for length, parts in product(LENGTH, (1, 2)):
            config = self.config(grad_accumulation_steps=parts, **LENGTH[length])
            name = f"{length}-{parts}"
            wholes.append({"config": config, "work_dir": str(tmp_path / f"{name}-whole")})
            cut: dict[str, Any] = {"config": config, "work_dir": str(tmp_path / f"{name}-cut")}
            # The last rank dies in the middle of a step, or the first in the middle of a save.
            step = {"signal": (self.ranks - 1, 6 * parts, signal.SIGKILL)}
            cuts.append({**cut, **(step if parts == 1 else {"kill_write": 150})})
            gone_on.append({**cut, "resume": "auto"})
        codes = self.start(*wholes, cuts[0])
        for number, run in enumerate(cuts):
            assert -signal.SIGKILL in codes, (
                f"run {number} was to be killed, and its processes ended with {codes}: it failed "
                "before that, or the resumed one before it did (see the output above)"
            )
            assert 0 not in codes, (
                f"one process of run {number} was killed, and the exit codes are {codes}, expected "
                "no 0: a rank that goes on alone believes that it has trained"
            )
            left, every = (folders(Path(r["work_dir"])) for r in (run, wholes[number]))
            assert 0 < len(left) < len(every), (
                f"a run that was killed left {len(left)} checkpoints, an uninterrupted one "
                f"{len(every)}, expected some, and fewer: it is to go on from one of them"
            )
            last = number + 1 == len(cuts)
            codes = self.start(gone_on[number], *([] if last else [cuts[number + 1]]))
        assert codes == [0] * self.ranks, _ended("the resumed runs", codes)
        for whole, run in zip(wholes, cuts, strict=True):
            folder = Path(run["work_dir"])
            said = (folder / "said.txt").read_text()
            assert "resuming from" in said, (
                f"the resumed run in {folder.name} said {said!r:.200}, expected 'resuming from': "
                "it began anew"
            )
            differ = differences(Path(whole["work_dir"]), folder)
            assert not differ, _differ(differ, "killed and resumed")

    def test_one_rank_that_is_told_to_stop_stops_all_with_all_saved(self, tmp_path: Path) -> None:
        config = self.config(max_steps=9)
        whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
        signalled = {"signal": (self.ranks - 1, 4, signal.SIGTERM), "notice_s": 0.0}
        codes = self.start(whole, {**cut, **signalled})
        assert codes == [1] * self.ranks, (
            f"one rank had SIGTERM, and the processes ended with {codes}, expected "
            f"{[1] * self.ranks}: all of them stop at the same step, with everything saved"
        )
        left = folders(tmp_path / "b")
        assert len(left) == 1, (
            f"a run that was told to stop left {len(left)} checkpoints, expected one, of the step "
            "at which it stopped"
        )
        (saved,) = left
        Checkpoint.open(saved).verify()
        codes = self.start({**cut, "resume": "auto"})
        assert codes == [0] * self.ranks, _ended("the resumed run", codes)
        said = (tmp_path / "b" / "said.txt").read_text()
        assert f"resuming from {saved}" in said, (
            f"the resumed run said {said!r:.200}, expected 'resuming from {saved}': it began anew"
        )
        ends = [folders(tmp_path / name)[-1] for name in "ab"]
        differ = checkpoint_differences(*ends)
        assert not differ, _differ(differ, "stopped and resumed")

    def test_it_trains_as_one_process_does_and_goes_on_there(self, tmp_path: Path) -> None:
        """A checkpoint of many processes is one of any number. A step has two batches."""
        # Both follow from how samples are shared between processes: no two numbers of them agree.
        plain: dict[str, Any] = {"dropout": 0.0, "centred": False}
        length = {
            **plain,
            "max_steps": 9,
            "save_iter_interval": 4,
            "grad_accumulation_steps": 2,
        }
        many = self.config(batch=2, **length)
        one = self.config(batch=2 * self.ranks, **length, type=self.reference)
        if self.reference != self.entry_point:
            for key in self.settings:
                del one["runner"][key]
        codes = self.start({"config": many, "work_dir": str(tmp_path / "many")})
        assert codes == [0] * self.ranks, _ended("the run", codes)
        train({"config": one, "work_dir": str(tmp_path / "one")})
        moved = tmp_path / "many"
        self._compare(moved, tmp_path / "one", f"{self.ranks} processes")
        resumed = str(folders(moved)[0])
        train({"config": one, "work_dir": str(moved), "resume": resumed})
        said = (moved / "said.txt").read_text()
        assert f"resuming from {resumed}" in said, (
            f"one process with a checkpoint of {self.ranks} said {said!r:.200}, expected "
            f"'resuming from {resumed}': it began anew"
        )
        changed = f"the number of processes is 1, the checkpoint's run had {self.ranks}"
        assert (changed in said) == (self.ranks > 1), (
            f"one process with a checkpoint of {self.ranks} said {said!r:.400}, expected "
            f"{changed!r} where the number differs: people must know"
        )
        self._compare(moved, tmp_path / "one", f"one process that goes on from {self.ranks}")

    def test_training_follows_from_its_seed(self, tmp_path: Path) -> None:
        runs: list[dict[str, Any]] = [
            {"config": self.config(max_steps=1, seed=seed), "work_dir": str(tmp_path / str(seed))}
            for seed in (42, 43)
        ]
        codes = self.start(*runs)
        assert codes == [0] * self.ranks, _ended("the runs", codes)
        weights = [Checkpoint.open(folders(Path(r["work_dir"]))[-1]).tensors(MODEL) for r in runs]
        learned = [n for n in weights[0] if n.endswith("weight") and weights[0][n].ndim > 1]
        differ = [name for name in learned if not torch.equal(weights[0][name], weights[1][name])]
        assert differ, (
            f"with seed = 42 and seed = 43 the weights are the same in all of {len(learned)} "
            "matrices, expected others: who trains three times to tell luck from skill would train "
            "once"
        )

    def _compare(self, run: Path, reference: Path, what: str) -> None:
        """The losses and weights of ``run`` are those of the reference, to rounding."""
        hint = (
            "expected at most 1e-4: the same samples in the same steps train the same; a strategy "
            "with another gradient or optimizer names a reference that has it too"
        )
        loss, weight = _loss_gap(run, reference), _weight_gap(run, reference)
        assert loss < 1e-4, (
            f"the losses of {what} and of {self.reference} are {loss:.3g} apart, {hint}"
        )
        assert weight < 1e-4, (
            f"the weights of {what} and of {self.reference} are {weight:.3g} apart, {hint}"
        )

    def test_parameters_without_dimensions_are_trained_or_refused(self, tmp_path: Path) -> None:
        """Refused by name and as an error of the input, before anything is trained."""
        refused = [kind for kind in SCALARS if kind not in self.scalars]
        for kind in refused:
            config = self.config(max_steps=1)
            config["model"]["scalar"] = kind
            run = {"config": config, "work_dir": str(tmp_path / kind)}
            codes = run_ranks(1, refusal, run)
            assert codes == [0], (
                f"a model with a {kind} parameter without dimensions was trained, or failed in "
                f"another way (exit codes {codes}), expected a ConfigError: it is none of scalars"
            )
            said = (tmp_path / kind / "refused.txt").read_text()
            assert "gain" in said, (
                f"a parameter without dimensions was refused with {said!r}, expected its name, "
                "'gain': people must find it in their model"
            )
            assert not folders(tmp_path / kind), "a run that was refused left a checkpoint"
        if self.scalars:
            run = {"config": self.config(max_steps=1), "work_dir": str(tmp_path / "trained")}
            codes = self.start(run)
            assert codes == [0] * self.ranks, _ended("a model with such a parameter", codes)
            saved = Checkpoint.open(folders(tmp_path / "trained")[-1]).tensors(MODEL)
            assert "gain" in saved, (
                f"a checkpoint has {', '.join(sorted(saved))}, expected the parameter 'gain' among "
                "them: the names are those of the model itself (unwrap_model)"
            )
            shape = tuple(saved["gain"].shape)
            assert shape == (), (
                f"a parameter without dimensions was saved with the shape {shape}, expected (): "
                "the model would not load it"
            )


def refusal(settings: Mapping[str, Any]) -> None:
    """One run that is refused for its config; writes the message to ``refused.txt``.

    Raises:
        AssertionError: it trains.
    """
    try:
        train(settings)
    except ConfigError as error:
        (Path(settings["work_dir"]) / "refused.txt").write_text(str(error))
        return
    raise AssertionError("the config was not refused")


def _loss_gap(a: Path, b: Path) -> float:
    rows = [[json.loads(line) for line in (d / "metrics.jsonl").open()] for d in (a, b)]
    steps = [[row["step"] for row in each] for each in rows]
    assert steps[0] == steps[1], (
        f"metrics.jsonl has the steps {steps[0]}, that of the reference {steps[1]}, expected the "
        "same: a step is one of the optimizer, whatever the number of processes"
    )
    return float(max(abs(x["loss"] - y["loss"]) for x, y in zip(*rows, strict=True)))


def _weight_gap(a: Path, b: Path) -> float:
    pair = [Checkpoint.open(folders(d)[-1]).tensors(MODEL) for d in (a, b)]
    differ = sorted(set(pair[0]) ^ set(pair[1]))
    assert not differ, (
        f"a checkpoint and that of the reference differ in the names {differ[:5]}, expected those "
        "of the model itself (unwrap_model): any strategy loads any checkpoint"
    )
    gaps = [(pair[0][name] - pair[1][name]).abs().max() for name in pair[0] if name != "batches"]
    return float(torch.stack(gaps).max())


def _ended(what: str, codes: Sequence[int | None]) -> str:
    return (
        f"{what} ended with the exit codes {list(codes)}, expected {[0] * len(codes)}; the error "
        "is "
        "in the output above"
    )


def _differ(names: Sequence[str], how: str) -> str:
    """The message for an interrupted run that left other files."""
    return (
        f"a run that was {how} left other bytes in {', '.join(names[:6])} than one that was not, "
        "expected the same: what the strategy keeps from one step to the next is not all in the "
        "checkpoint (as buffers of the model, or in the state of the optimizer), or it draws "
        "random numbers from elsewhere"
    )
