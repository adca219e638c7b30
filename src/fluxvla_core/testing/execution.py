"""The kit for models that divide their answer (``VLA.observe`` and ``VLA.denoise``)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.policies.execution import Compiled, Eager, Graphed, HostClock, Parts
from fluxvla_core.policies.inference_weights import store_in_bf16
from fluxvla_core.testing.capture import Tape, check_capturable, count_calls
from fluxvla_core.training.model import blocks_of, compile_units

CLOSE = 1e-5
"""Relative: sums in another order, in float32."""


class ExecutionConformance:
    """However it is executed, a model gives the same actions; and its steps can be captured.

    Subclass it and define :meth:`model` and :meth:`batches`. Nothing here needs a GPU: a capture is
    played by :class:`fluxvla_core.testing.capture.Tape`.
    """

    kinds = 8
    """So many pieces of code may be compiled: kinds of blocks, not blocks. torch gives up on a
    method that it has compiled eight times."""

    @abstractmethod
    def model(self) -> Any:
        """A small model in evaluation mode."""

    @abstractmethod
    def batches(self) -> Sequence[Mapping[str, Any]]:
        """Two or more different batches of the same shapes, as ``predict_action`` takes them."""

    def test_its_two_parts_are_its_answer(self) -> None:
        model, batch = self.model(), self.batches()[0]
        clock = HostClock()
        with torch.inference_mode():
            _same(Eager(model).answer(batch, clock), model.predict_action(**batch))
        assert list(clock.seconds()) == ["prefix", "denoise"]

    def test_a_recording_gives_each_batch_its_own_answer(self) -> None:
        model, batches = self.model(), self.batches()
        execution = Graphed(model, Tape)
        with torch.inference_mode():
            expected = [model.predict_action(**batch) for batch in batches]
            for number in (0, 1, 0):
                found = execution.answer(batches[number], HostClock())
                _same(found, expected[number])
        gap = float((expected[0] - expected[1]).abs().max())
        assert gap > CLOSE, f"the batches' answers are only {gap:.2g} apart"

    def test_the_steps_wait_for_nothing(self) -> None:
        """No value is read back, no shape depends on one, nothing is copied from the host."""
        model, batch = self.model(), self.batches()[0]
        parts = Parts.of(model)
        assert parts is not None
        observation = parts.observation(batch)
        with torch.inference_mode():
            seen, tables = model.observe(**observation), model.step_tables()
            check_capturable(lambda: model.denoise(seen, batch["noise"], tables))
            if model.observe_is_capturable:
                check_capturable(lambda: model.observe(**observation))

    def test_the_steps_meet_nothing_of_the_host(self) -> None:
        """On the meta device, where a tensor of the host's is another device's, as on a GPU."""
        model, batch = self.model(), self.batches()[0]
        parts = Parts.of(model)
        assert parts is not None
        observation = parts.observation(batch)
        with torch.inference_mode():
            seen, tables = model.observe(**observation), model.step_tables()
            bare = model.to("meta")
            there = [_bare(group) for group in (seen, tables, observation)]
            noise = batch["noise"].to("meta")
            found = check_capturable(lambda: bare.denoise(there[0], noise, there[1]))
            if model.observe_is_capturable:
                again = check_capturable(lambda: bare.observe(**there[2]))
                shapes = {name: (t.shape, t.dtype) for name, t in again.items()}
                assert shapes == {name: (t.shape, t.dtype) for name, t in seen.items()}
        assert found.shape == batch["noise"].shape

    def test_a_model_s_memory_is_computed_once(self) -> None:
        """Blocks that do not see the noise run once an answer, whatever the number of steps."""
        model, batch = self.model(), self.batches()[0]
        parts = Parts.of(model)
        assert parts is not None
        with torch.inference_mode():
            with count_calls(model) as early:
                seen = model.observe(**parts.observation(batch))
            with count_calls(model) as late:
                model.denoise(seen, batch["noise"], model.step_tables())
        blocks = {id(block) for block in blocks_of(model)}
        names = [name for name, module in model.named_modules() if id(module) in blocks]
        again = [name for name in names if early[name] > 1 or (early[name] and late[name])]
        assert not again, f"computed more than once an answer: {', '.join(again)}"

    def test_bf16_weights_are_what_autocast_makes_of_them(self) -> None:
        model, batch = self.model(), self.batches()[0]
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
            expected = model.predict_action(**batch).clone()
            store_in_bf16(model)
            found = model.predict_action(**batch)
        kept = {p.dtype for module in model.exact_modules() for p in module.parameters()}
        assert kept <= {torch.float32}, f"exact_modules() were stored as {kept}"
        assert torch.equal(found, expected), f"{float((found - expected).abs().max()):.3g} apart"

    def test_its_blocks_are_compiled_once_by_kind(self) -> None:
        """And not again for the next batch. The code is not translated, which takes a minute."""
        model, batches = self.model(), self.batches()
        execution, counts = Compiled(model), []
        with _forgotten(), torch.inference_mode():
            expected = [model.predict_action(**batch) for batch in batches]
            compile_units(model, dynamic=False, backend="eager")
            for number in (0, 1):
                found = execution.answer(batches[number], HostClock())
                _same(found, expected[number])
                counts.append(torch._dynamo.utils.counters["stats"]["unique_graphs"])
        blocks = len(blocks_of(model))
        assert counts[0] > 0, "nothing was compiled: does predict_action() call its blocks?"
        assert counts[1] == counts[0], f"the second answer compiled {counts[1] - counts[0]} more"
        assert counts[0] <= self.kinds, (
            f"{blocks} blocks were compiled as {counts[0]} graphs, {self.kinds} kinds are expected"
        )


def _same(found: Tensor, expected: Tensor) -> None:
    gap = float((found - expected).abs().max()) / float(expected.abs().max())
    assert gap < CLOSE, f"{gap:.3g} apart, of the largest number"


def _bare(tensors: Mapping[str, Any]) -> dict[str, Any]:
    return {n: t.to("meta") if isinstance(t, Tensor) else t for n, t in tensors.items()}


@contextmanager
def _forgotten() -> Iterator[None]:
    """What was compiled before, and what is compiled inside, is forgotten."""
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    try:
        yield
    finally:
        torch._dynamo.reset()
