"""Conformance tests for train runners, which a plugin inherits.

    from fluxvla_core.testing.train_runner import TrainRunnerConformance

    class TestMyTrainRunner(TrainRunnerConformance):
        entry_point = "MyTrainRunner"
        ranks = 2

pytest collects the inherited tests. They start real processes on the loopback, kill some of them,
and compare what is left bit for bit.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import torch

from fluxvla_core.checkpoints.checkpoint import MODEL, Checkpoint, folders
from fluxvla_core.errors import ConfigError
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


class TrainRunnerConformance:
    """Inherit, set ``entry_point``, and run pytest."""

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
            assert -signal.SIGKILL in codes, (number, codes)
            assert 0 not in codes
            left = folders(Path(run["work_dir"]))
            assert 0 < len(left) < len(folders(Path(wholes[number]["work_dir"])))
            last = number + 1 == len(cuts)
            codes = self.start(gone_on[number], *([] if last else [cuts[number + 1]]))
        assert codes == [0] * self.ranks
        for whole, run in zip(wholes, cuts, strict=True):
            folder = Path(run["work_dir"])
            assert "resuming from" in (folder / "said.txt").read_text()
            assert differences(Path(whole["work_dir"]), folder) == []

    def test_one_rank_that_is_told_to_stop_stops_all_with_all_saved(self, tmp_path: Path) -> None:
        config = self.config(max_steps=9)
        whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
        told = {"signal": (self.ranks - 1, 4, signal.SIGTERM), "notice_s": 0.0}
        assert self.start(whole, {**cut, **told}) == [1] * self.ranks
        (saved,) = folders(tmp_path / "b")
        Checkpoint.open(saved).verify()
        assert self.start({**cut, "resume": "auto"}) == [0] * self.ranks
        assert f"resuming from {saved}" in (tmp_path / "b" / "said.txt").read_text()
        ends = [folders(tmp_path / name)[-1] for name in "ab"]
        assert checkpoint_differences(*ends) == []

    def test_it_trains_as_one_process_does_and_goes_on_there(self, tmp_path: Path) -> None:
        """A checkpoint of many processes is one of any number."""
        # Both follow from how samples are shared between processes: no two numbers of them agree.
        plain: dict[str, Any] = {"dropout": 0.0, "centred": False}
        length = {**plain, "max_steps": 9, "save_iter_interval": 4}
        many = self.config(batch=2, **length)
        one = self.config(batch=2 * self.ranks, **length, type=self.reference)
        if self.reference != self.entry_point:
            for key in self.settings:
                del one["runner"][key]
        assert self.start({"config": many, "work_dir": str(tmp_path / "many")}) == [0] * self.ranks
        train({"config": one, "work_dir": str(tmp_path / "one")})
        moved = tmp_path / "many"
        assert _loss_gap(moved, tmp_path / "one") < 1e-4
        assert _weight_gap(moved, tmp_path / "one") < 1e-4
        resumed = str(folders(moved)[0])
        train({"config": one, "work_dir": str(moved), "resume": resumed})
        said = (moved / "said.txt").read_text()
        assert f"resuming from {resumed}" in said
        changed = f"the number of processes is 1, the checkpoint's run had {self.ranks}"
        assert (changed in said) == (self.ranks > 1)
        assert _loss_gap(moved, tmp_path / "one") < 1e-4
        assert _weight_gap(moved, tmp_path / "one") < 1e-4

    def test_parameters_without_dimensions_are_trained_or_refused(self, tmp_path: Path) -> None:
        """Refused by name and as an error of the input, before anything is trained."""
        refused = [kind for kind in SCALARS if kind not in self.scalars]
        for kind in refused:
            config = self.config(max_steps=1)
            config["model"]["scalar"] = kind
            run = {"config": config, "work_dir": str(tmp_path / kind)}
            assert run_ranks(1, refusal, run) == [0]
            assert "gain" in (tmp_path / kind / "refused.txt").read_text()
            assert not folders(tmp_path / kind)
        if self.scalars:
            run = {"config": self.config(max_steps=1), "work_dir": str(tmp_path / "trained")}
            assert self.start(run) == [0] * self.ranks
            saved = Checkpoint.open(folders(tmp_path / "trained")[-1]).tensors(MODEL)
            assert saved["gain"].shape == ()


def refusal(settings: Mapping[str, Any]) -> None:
    """One run that is refused for its config; writes what it says to ``refused.txt``.

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
    assert [row["step"] for row in rows[0]] == [row["step"] for row in rows[1]]
    return float(max(abs(x["loss"] - y["loss"]) for x, y in zip(*rows, strict=True)))


def _weight_gap(a: Path, b: Path) -> float:
    pair = [Checkpoint.open(folders(d)[-1]).tensors(MODEL) for d in (a, b)]
    assert set(pair[0]) == set(pair[1])
    gaps = [(pair[0][name] - pair[1][name]).abs().max() for name in pair[0] if name != "batches"]
    return float(torch.stack(gaps).max())
