"""Conformance tests for metrics, which a plugin inherits.

    from fluxvla_core.testing import MetricConformance

    class TestMyMetric(MetricConformance):
        entry_point = "MyMetric"

pytest collects the inherited tests. They call a metric as a training does, on its first rank.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from fluxvla_core.build import RunContext, build_from_cfg
from fluxvla_core.contracts.training import Metric
from fluxvla_core.plugins.registry import METRICS
from fluxvla_core.testing._conformance import Conformance, calling, is_json

_ANY = (
    "which keys there are depends on the run, so use those that are there (config() and "
    "record(step) of this kit's subclass set what it is given)"
)


class MetricConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    registry = "metrics"

    def make_in(self, work_dir: Path) -> Metric:
        """A new metric, as the runner builds it."""
        work_dir.mkdir(parents=True, exist_ok=True)
        context = RunContext(work_dir=work_dir, section="runner", config=self.config())
        table = {"type": self.entry_point, **self.arguments}
        return Metric.adapt(build_from_cfg(table, METRICS, context))

    def config(self) -> Mapping[str, Any]:
        """The config of the run."""
        return {"runner": {"type": "MyTrainRunner", "max_steps": 4}}

    @pytest.fixture
    def metric(self, tmp_path: Path) -> Metric:
        """A new metric, not started."""
        return self.make_in(tmp_path)

    def record(self, step: int) -> dict[str, Any]:
        """The numbers of optimizer step ``step``, as the training commits them."""
        return {
            "global_step": step, "epoch": 0, "loss": 1.0 / step, "lr": 1e-3, "grad_norm": 0.5,
            "step_time": 0.1, "samples_per_s": 80.0, "data_wait": 0.01, "loss/first": 0.5,
        }  # fmt: skip

    def commit(self, metric: Metric, first: int, last: int) -> None:
        """The steps from ``first`` to ``last``, each pushed."""
        for step in range(first, last + 1):
            with calling(f"{self.entry_point}.commit()", self.record(step), _ANY):
                metric.commit(**self.record(step))
            metric.push()

    def start(self, metric: Metric, step: int = 0) -> None:
        """The training begins after ``step``."""
        given = {"step": step, "config": self.config()}
        with calling(f"{self.entry_point}.start()", given, _ANY):
            metric.start(step, self.config())

    def test_a_training_calls_it(self, metric: Metric) -> None:
        self.start(metric)
        self.commit(metric, 1, 3)
        metric.push()  # there may be nothing new
        metric.sync()
        metric.finalize()

    def test_numbers_of_any_name_are_taken(self, metric: Metric) -> None:
        self.start(metric)
        problem = ""
        try:
            metric.commit(**{**self.record(1), "val_loss": 0.7, "loss/second": 0.1, "new": 1.0})
        except (TypeError, KeyError) as error:
            problem = f"{type(error).__name__}: {error}"
        assert not problem, (
            f"commit() with val_loss and other numbers raised {problem}, expected it to take any: "
            "which there are depends on the run (validation, mixtures, GPUs)"
        )
        metric.finalize()

    def test_the_record_belongs_to_the_caller(self, metric: Metric) -> None:
        record, config = self.record(1), dict(self.config())
        with calling(f"{self.entry_point}.start() or commit()", record, _ANY):
            metric.start(0, config)
            metric.commit(**record)
        metric.push()
        assert record == self.record(1), "commit() changed the numbers that it was given"
        assert config == self.config(), "start() changed the config that it was given"
        metric.finalize()

    def test_its_state_goes_into_a_checkpoint(self, metric: Metric) -> None:
        self.start(metric)
        self.commit(metric, 1, 3)
        state = metric.state_dict()
        metric.finalize()
        assert is_json(state), (
            f"state_dict() gave {state!r:.200}, expected JSON values alone: it is kept in the "
            "checkpoint's JSON"
        )

    def test_it_goes_on_from_a_checkpoint(self, metric: Metric, tmp_path: Path) -> None:
        self.start(metric)
        self.commit(metric, 1, 2)
        metric.sync()
        saved = metric.state_dict()
        self.commit(metric, 3, 4)
        whole = metric.state_dict()
        metric.finalize()
        resumed = self.make_in(tmp_path)
        resumed.load_state_dict(saved)
        self.start(resumed, 2)
        self.commit(resumed, 3, 4)
        found = resumed.state_dict()
        resumed.finalize()
        assert found == whole, (
            f"after load_state_dict() of step 2 and steps 3 and 4 state_dict() is {found!r:.200}, "
            f"expected {whole!r:.200} as of a run that was never stopped: a resumed run's records "
            "would differ"
        )

    def test_a_state_is_not_changed_later(self, metric: Metric) -> None:
        self.start(metric)
        self.commit(metric, 1, 2)
        state = metric.state_dict()
        kept = repr(state)
        self.commit(metric, 3, 4)
        metric.finalize()
        assert repr(state) == kept, (
            "later steps changed what state_dict() had given, expected a copy: a checkpoint is "
            "written while training goes on"
        )

    def test_it_may_end_without_a_step(self, metric: Metric) -> None:
        self.start(metric)
        metric.push()
        metric.sync()
        metric.finalize()
