"""Conformance tests for VLA models, which a plugin inherits.

    from fluxvla_core.testing import ModelConformance

    class TestMyVLA(ModelConformance):
        entry_point = "MyVLA"
        arguments = {"width": 16}

pytest collects the inherited tests. They run a small model on the CPU; training, checkpoints and
robots rely on what they check.
"""

from __future__ import annotations

import inspect
import random
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import VLA
from fluxvla_core.testing._conformance import Conformance, calling, capability, equal, numbers
from fluxvla_core.training.input_sizes import chunk_of, declared_sizes, misfits

_CLOSE = 1e-4
_REPEATS = 2
# Keys of a batch that a robot's observations do not have.
_LEARNT_FROM = ("actions", "action_masks", "time", "sample_ids")


@dataclass(frozen=True)
class Sizes:
    """Of a batch of the kit, by the attributes of ``ModelConformance`` that set them."""

    state_dim: int
    cameras: int
    image_size: tuple[int, int]
    words: int
    vocabulary: int


class ModelConformance(Conformance):
    """Inherit, set ``entry_point``, ``arguments`` of a small model, and run pytest."""

    registry = "vlas"
    action_shape: ClassVar[tuple[int, int]] = (4, 7)
    """``(T, D)`` of a chunk, for a model that has no ``action_shape`` itself."""
    state_dim: ClassVar[int | None] = None
    """Numbers of a state; None: the constructor's ``state_dim`` or ``max_state_dim``, else 7."""
    cameras: ClassVar[int | None] = None
    """Images of an observation, whose channels stand one behind the other; None: the
    constructor's ``num_cameras``, else 2."""
    image_size: ClassVar[tuple[int, int] | None] = None
    """Height and width of an image; None: the constructor's ``image_size``, else 32 and 32."""
    words: ClassVar[int] = 8
    """Tokens of a prompt."""
    vocabulary: ClassVar[int | None] = None
    """Tokens that there are; None: the constructor's ``vocab_size``, else 100."""
    steps: ClassVar[int] = 40
    """Steps in which the loss of one batch must fall by a tenth."""
    learning_rate: ClassVar[float] = 1e-2
    """Learning rate of these steps, with AdamW."""
    unused: ClassVar[tuple[str, ...]] = ()
    """Beginnings of the names of trainable parameters that a step may leave out."""

    @pytest.fixture
    def model(self) -> nn.Module:
        """A new model, from seed 0."""
        return self.built()

    def built(self, seed: int = 0) -> nn.Module:
        """A model whose weights follow from ``seed``."""
        _seed(seed)
        model: nn.Module = self.make()
        return model

    def shape_of(self, model: nn.Module) -> tuple[int, int]:
        """``(T, D)`` of its chunks."""
        return VLA.adapt(model).action_shape or self.action_shape

    def sizes(self) -> Sizes:
        """The sizes of a batch: as set here, or else as the constructor has them."""
        stated = self.stated()

        def known(own: Any, names: Sequence[str], other: Any) -> Any:
            return next((v for v in (own, *_named(stated, names)) if v is not None), other)

        side = known(self.image_size, ("image_size",), (32, 32))
        return Sizes(
            state_dim=known(self.state_dim, ("state_dim", "max_state_dim"), 7),
            cameras=known(self.cameras, ("num_cameras",), 2),
            image_size=(side, side) if isinstance(side, int) else tuple(side),
            words=self.words,
            vocabulary=known(self.vocabulary, ("vocab_size",), 100),
        )

    def batch(self, model: nn.Module, size: int = 2) -> dict[str, Tensor]:
        """``size`` samples with every key that datasets and transforms of the core give.

        ``noise`` ``(B, K, T, D)`` and ``time`` ``(B, K)`` are as of ``SampleFlowNoise(repeats=2)``;
        ``predict_action`` gets a ``noise`` ``(B, T, D)``.
        Override it for a model that takes other keys, or others of their shapes.
        """
        length, dim = self.shape_of(model)
        draw = torch.Generator().manual_seed(1)
        of = self.sizes()
        return {
            "states": torch.randn(size, of.state_dim, generator=draw),
            "images": torch.rand(size, 3 * of.cameras, *of.image_size, generator=draw),
            "img_masks": torch.ones(size, of.cameras, dtype=torch.bool),
            "lang_tokens": torch.randint(1, of.vocabulary, (size, of.words), generator=draw),
            "lang_masks": torch.ones(size, of.words, dtype=torch.bool),
            "embodiment_ids": torch.zeros(size, dtype=torch.int64),
            "actions": torch.randn(size, length, dim, generator=draw),
            "action_masks": torch.ones(size, length),
            "noise": torch.randn(size, _REPEATS, length, dim, generator=draw),
            "time": torch.rand(size, _REPEATS, generator=draw),
            "sample_ids": torch.arange(size),
        }

    def training_batch(self, model: nn.Module, size: int = 2) -> dict[str, Tensor]:
        """The keys of ``batch`` that the model's ``forward`` takes."""
        capability(implements(model, VLA, "forward"), "a model to be trained defines forward(...)")
        keys, batch = VLA.adapt(model).batch_keys(), self.batch(model, size)
        if keys is None:
            return batch
        lacks = [key for key, needed in keys.items() if needed and key not in batch]
        assert not lacks, (
            f"{self.entry_point}.forward needs {', '.join(lacks)}, and the batch of this kit has "
            f"{', '.join(batch)}: override batch(model, size) with what your transforms make"
        )
        return {key: value for key, value in batch.items() if key in keys}

    def robot_batch(self, model: nn.Module, size: int = 2) -> dict[str, Tensor]:
        """The keys of ``batch`` that the model's ``predict_action`` takes, without actions."""
        own = implements(model, VLA, "predict_action")
        capability(own, "a model that is to act defines predict_action(...)")
        method: Any = model.predict_action
        parameters = inspect.signature(method).parameters.values()
        everything = any(p.kind is p.VAR_KEYWORD for p in parameters)
        batch = {k: v for k, v in self.batch(model, size).items() if k not in _LEARNT_FROM}
        shape, draw = (size, *self.shape_of(model)), torch.Generator().manual_seed(2)
        batch["noise"] = torch.randn(shape, generator=draw)
        named = {p.name for p in parameters}
        lacks = [
            p.name
            for p in parameters
            if p.default is p.empty
            and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
            and p.name not in batch
        ]
        assert not lacks, (
            f"{self.entry_point}.predict_action needs {', '.join(lacks)}, and an observation has "
            f"{', '.join(batch)}: a robot has no actions to learn from; for keys of your own "
            "transforms override batch(model, size)"
        )
        return {k: v for k, v in batch.items() if everything or k in named}

    def loss(self, model: nn.Module, batch: Mapping[str, Tensor], seed: int = 3) -> Tensor:
        """The loss of ``batch``, with whatever the model draws following from ``seed``."""
        _seed(seed)
        with self._calling("forward()", batch):
            output = model(**batch)
        loss = output.get("loss") if isinstance(output, Mapping) else None
        assert isinstance(loss, Tensor), (
            f"forward() gave {_said(output)}, expected a mapping with 'loss': the training step "
            "reads it by that name"
        )
        assert loss.ndim == 0, (
            f"forward() gave a loss of shape {tuple(loss.shape)}, expected one number: the mean "
            "over the batch (losses of its own for each sample go under 'sample_losses')"
        )
        return loss

    def trained(self, model: nn.Module, steps: int) -> list[float]:
        """The losses of ``steps`` steps on one batch."""
        batch = self.training_batch(model)
        trainable = [p for p in model.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(trainable, self.learning_rate, weight_decay=0.0)
        losses = []
        for _ in range(steps):
            loss = self.loss(model, batch)
            losses.append(loss.item())
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        return losses

    def _calling(self, what: str, batch: Mapping[str, Any]) -> AbstractContextManager[None]:
        stated = numbers(self.stated())
        takes = f"; {self.entry_point} was made with {stated}" if stated else ""
        hint = (
            "set state_dim, cameras, image_size, words, vocabulary and action_shape of this kit's "
            "subclass to what it takes, or override batch(model, size) (fluxvla plugins check: "
            f"--kit FILE with such a subclass){takes}"
        )
        return calling(f"{self.entry_point}.{what}", batch, hint)

    def predicted(self, model: nn.Module, batch: Mapping[str, Any]) -> Tensor:
        """``predict_action`` as a robot's policy calls it."""
        method: Any = model.eval().predict_action
        with torch.inference_mode(), self._calling("predict_action()", batch):
            found: Tensor = method(**batch)
        assert isinstance(found, Tensor), (
            f"predict_action() gave {_said(found)}, expected a tensor (B, T, D): it is moved to "
            "the host and denormalised"
        )
        return found

    # -- training --------------------------------------------------------------------------------

    def test_forward_gives_a_loss(self, model: nn.Module) -> None:
        loss = self.loss(model, self.training_batch(model))
        assert torch.isfinite(loss), (
            f"forward() gave the loss {loss.item()}, expected a finite one: training ends at the "
            "first that is not"
        )
        assert loss.requires_grad, (
            "forward() gave a loss that depends on no trainable parameter, expected one to learn "
            "from: is it detached, or computed under torch.no_grad()?"
        )

    def test_every_trainable_parameter_gets_a_gradient(self, model: nn.Module) -> None:
        self.loss(model, self.training_batch(model)).backward()  # type: ignore[no-untyped-call]
        without = [
            name
            for name, parameter in model.named_parameters()
            if parameter.requires_grad and parameter.grad is None and not self._may_rest(name)
        ]
        assert not without, (
            f"after backward() {_listed(without)} have no gradient, expected one for every "
            "trainable parameter: DDP waits for each of them; freeze what is not trained "
            "(requires_grad_(False)), or name it in unused"
        )

    def _may_rest(self, name: str) -> bool:
        return any(name.startswith(beginning) for beginning in self.unused)

    def test_the_sizes_that_it_declares_are_those_that_it_takes(self, model: nn.Module) -> None:
        table = {"type": self.component(), **self.arguments}
        declared = declared_sizes(table)
        capability(bool(declared), "input_sizes would let data that do not fit be refused earlier")
        wrong = [one.text for one in misfits(table, self.batch(model), declared)]
        chunk, shape = chunk_of(declared), VLA.adapt(model).action_shape
        if chunk is not None and shape is not None and chunk != tuple(shape):
            wrong.append(f"{self.entry_point}: chunks are {chunk}, action_shape is {tuple(shape)}")
        assert not wrong, (
            f"input_sizes does not say what forward() takes: {'; '.join(wrong)}, expected the "
            "sizes of this kit's batch: data that fit would be refused"
        )

    def test_it_learns_one_batch(self, model: nn.Module) -> None:
        losses = self.trained(model, self.steps)
        assert losses[-1] < 0.9 * losses[0], (
            f"{self.steps} steps of AdamW on one batch took the loss from {losses[0]:.4g} to "
            f"{losses[-1]:.4g}, expected less than nine tenths: a model that cannot learn two "
            "samples by heart learns no dataset (or set steps and learning_rate)"
        )

    def test_random_numbers_are_those_of_the_checkpoint(self, model: nn.Module) -> None:
        batch = self.training_batch(model)
        losses = [self.loss(self.built(), batch, 5).item() for _ in range(2)]
        assert losses[0] == losses[1], (
            f"forward() of one batch gave {losses[0]:.6g} and {losses[1]:.6g} from the same random "
            "state of torch, numpy and Python, expected the same: a generator of its own is in no "
            "checkpoint, and a resumed run would go another way"
        )

    def test_the_batch_belongs_to_the_caller(self, model: nn.Module) -> None:
        batch = self.training_batch(model)
        before = {key: value.clone() for key, value in batch.items()}
        self.loss(model, batch).backward()  # type: ignore[no-untyped-call]
        changed = [key for key in before if not torch.equal(batch[key], before[key])]
        assert not changed, (
            f"forward() changed {_listed(changed)} of the batch, expected it untouched: the same "
            "tensors are used again where layers are recomputed"
        )

    def test_what_it_learns_is_in_its_state_dict(self, model: nn.Module) -> None:
        self.trained(model, 3)
        other = self.built(seed=8)
        other.load_state_dict(model.state_dict())
        batch = self.training_batch(model)
        losses = [self.loss(one.eval(), batch).item() for one in (model, other)]
        assert losses[0] == pytest.approx(losses[1], rel=_CLOSE), (
            f"a new model with the state_dict() of a trained one has the loss {losses[1]:.6g} "
            f"where that has {losses[0]:.6g}, expected the same: a checkpoint holds the "
            "state_dict() "
            "alone, so that what is kept elsewhere is lost (register_buffer keeps it)"
        )

    def test_it_trains_in_bf16(self, model: nn.Module) -> None:
        with torch.autocast("cpu", torch.bfloat16):
            loss = self.loss(model, self.training_batch(model))
        loss.backward()  # type: ignore[no-untyped-call]
        assert torch.isfinite(loss), (
            f"in bf16 forward() gave the loss {loss.item()}, expected a finite one, as with "
            "enable_mixed_precision_training"
        )

    def test_its_fsdp_units_are_called(self, model: nn.Module) -> None:
        units = list(_flat(VLA.adapt(model).fsdp_units()))
        capability(bool(units), "fsdp_units() would name the blocks to shard, recompute, compile")
        inside = set(model.modules())
        strangers = [type(unit).__name__ for unit in units if unit not in inside]
        assert not strangers, (
            f"fsdp_units() gave {_listed(strangers)}, which are no modules of the model, expected "
            "modules of its own: their weights would be sharded and never gathered"
        )
        called: set[nn.Module] = set()
        for unit in units:
            unit.register_forward_pre_hook(lambda module, _: called.add(module))
        self.loss(model, self.training_batch(model))
        missing = [name for name, unit in model.named_modules() if unit in {*units} - called]
        assert not missing, (
            f"forward() never called {_listed(missing)} of fsdp_units(), expected a call of each "
            "unit itself: sharded weights are gathered when a unit is called, so that the use of "
            "an inner layer alone would find none"
        )

    # -- acting ----------------------------------------------------------------------------------

    def test_predicted_chunks_have_their_shape(self, model: nn.Module) -> None:
        found = self.predicted(model, self.robot_batch(model))
        expected = (2, *self.shape_of(model))
        assert tuple(found.shape) == expected, (
            f"predict_action() gave the shape {tuple(found.shape)} for a batch of 2, expected "
            f"{expected}: (B, T, D), with T and D as action_shape says"
        )
        assert torch.isfinite(found).all(), (
            "predict_action() gave a number that is not finite, expected finite ones: the safety "
            "stops the robot at the first"
        )

    def test_an_answer_can_be_repeated(self, model: nn.Module) -> None:
        batch = self.robot_batch(model)
        answers = []
        for seed in (1, 2):
            _seed(seed)
            answers.append(self.predicted(model, batch))
        gap = (answers[0] - answers[1]).abs().max().item()
        assert gap == 0.0, (
            f"predict_action() gave actions {gap:.3g} apart for one observation, expected the "
            "same: take the argument noise instead of drawing random numbers, because the policy "
            "draws "
            "it from the episode's seed"
        )

    def test_rows_do_not_depend_on_each_other(self, model: nn.Module) -> None:
        batch = self.robot_batch(model)
        both = self.predicted(model, batch)
        for row in (0, 1):
            alone = self.predicted(
                model, {key: value[row : row + 1] for key, value in batch.items()}
            )
            gap = (both[row] - alone[0]).abs().max().item()
            assert gap < _CLOSE * max(1.0, alone.abs().max().item()), (
                f"predict_action() gave row {row} of a batch of 2 actions {gap:.3g} from those "
                "that "
                "it gave the same row alone, expected the same: an evaluation asks for several "
                "episodes at once"
            )

    def test_the_observation_belongs_to_the_caller(self, model: nn.Module) -> None:
        batch = self.robot_batch(model)
        before = {key: value.clone() for key, value in batch.items()}
        self.predicted(model, batch)
        changed = [key for key in before if not equal(batch[key], before[key])]
        assert not changed, (
            f"predict_action() changed {_listed(changed)} of its arguments, expected them untouched"
        )


def _seed(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def _named(table: Mapping[str, Any], names: Sequence[str]) -> Iterator[Any]:
    """Values of these names in ``table``, then in the tables of its parts."""
    yield from (table[name] for name in names if name in table)
    for part in table.values():
        if isinstance(part, Mapping):
            yield from _named(part, names)


def _flat(units: Sequence[Any]) -> Iterator[nn.Module]:
    for unit in units:
        yield from unit if isinstance(unit, tuple) else (unit,)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more


def _said(output: Any) -> str:
    keys = f" of {', '.join(map(str, output))}" if isinstance(output, Mapping) else ""
    return f"a {type(output).__name__}{keys}"
