"""What a training needs is counted without memory, and equals what real tensors take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from fluxvla_core.training.optimizers import SGD, AdamW

torch = pytest.importorskip("torch")
from torch import nn  # noqa: E402

from fluxvla_core.training import cost  # noqa: E402
from fluxvla_core.training.model import (  # noqa: E402
    checkpoint_activations,
    nbytes,
    replicated_layout,
)

BATCH = {"x": torch.zeros(4, 8, 32), "y": torch.zeros(4, 8, 32)}
BF16 = torch.bfloat16


class Layer(nn.Module):
    """Attention and a perceptron, with norms, casts, views and dropout."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.dropout = nn.Dropout(0.1)

    def forward(self, x: Any) -> Any:
        heads = self.norm(x).unflatten(-1, (4, -1)).transpose(1, 2)
        seen = nn.functional.scaled_dot_product_attention(heads, heads, heads)
        x = x + seen.transpose(1, 2).flatten(-2)
        return x + self.dropout(self.down(nn.functional.gelu(self.up(self.norm(x)))))


class Stack(nn.Module):
    """Layers as units, one frozen layer in front, a check of values, and tied weights."""

    action_shape = (8, 32)

    def __init__(self, width: int = 32, decides: str = "") -> None:
        super().__init__()
        self.front = nn.Linear(width, width).requires_grad_(False)
        self.layers = nn.ModuleList(Layer(width) for _ in range(3))
        self.out, self.tied = nn.Linear(width, width), nn.Linear(width, width)
        self.tied.weight = self.out.weight
        self.register_buffer("scale", torch.ones(width))
        self.decides = decides

    def fsdp_units(self) -> list[nn.Module]:
        return list(self.layers)

    def forward(self, x: Any, y: Any) -> dict[str, Any]:
        if bool((y < 0).any()):
            raise ValueError("below 0")
        if self.decides == "count":
            x = x[: int(y.sum()) + 1]
        x = self.front(x)
        for layer in self.layers:
            x = layer(x)
        return {"loss": (self.tied(self.out(x)) * self.scale - y).square().mean()}


def on_meta(**settings: Any) -> Stack:
    with torch.device("meta"):
        return Stack(**settings)


@pytest.mark.parametrize("dtype", [None, BF16], ids=["float32", "bfloat16"])
def test_what_autograd_keeps_is_counted_without_memory(dtype: Any) -> None:
    real, again = Stack(), Stack()
    checkpoint_activations(again)
    kept, left = (
        cost.saved_activations(real, BATCH, dtype),
        cost.saved_activations(again, BATCH, dtype),
    )
    told = cost.fake_activations(cost.fake(on_meta()), BATCH, dtype)
    # The statistics of norms of bf16 inputs are fp32 on a CPU, and bf16 where nothing is computed.
    margin = 0.01 if dtype else 0
    assert told.activations == pytest.approx(kept.activations, rel=margin)
    assert told.largest_unit == pytest.approx(kept.largest_unit, rel=margin)
    assert told.recomputed == pytest.approx(left.activations, rel=margin)
    assert told.batch == kept.batch == 2 * 4 * 8 * 32 * 4
    # In bf16 autocast copies the trained matrices and their biases, but not the norms.
    copied = [p for n, p in real.named_parameters() if p.requires_grad and "norm" not in n]
    assert told.weight_copies == kept.weight_copies == (nbytes(copied) // 2 if dtype else 0)


def test_what_is_kept_is_counted_by_hand() -> None:
    """A linear layer keeps its input, a square its own; weights and batches are no activations."""

    class One(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first, self.second = nn.Linear(6, 5), nn.Linear(5, 3)

        def forward(self, x: Any) -> dict[str, Any]:
            return {"loss": self.second(self.first(x)).square().mean()}

    kept = cost.saved_activations(One(), {"x": torch.zeros(2, 6)}, None)
    assert kept.activations == 4 * (2 * 5 + 2 * 3)
    assert (kept.batch, kept.weight_copies) == (4 * 2 * 6, 0)


def test_recomputing_keeps_what_goes_into_units_and_tells_of_the_largest() -> None:
    kept = cost.fake_activations(cost.fake(on_meta()), BATCH, None)
    found = replicated_layout(on_meta())
    plain, again = (cost.footprint(found, kept, 0, False, r) for r in (False, True))
    assert (plain.activations, plain.recomputed) == (kept.activations, 0)
    assert (again.activations, again.recomputed) == (kept.recomputed, kept.largest_unit)
    assert kept.recomputed < kept.activations / 5
    # Three layers, and little besides.
    assert kept.activations - kept.recomputed == pytest.approx(3 * kept.largest_unit, rel=0.1)


def test_a_model_that_decides_by_numbers_cannot_be_counted() -> None:
    counted = cost.fake(on_meta(decides="count"))
    with pytest.raises(Exception, match="_local_scalar_dense"):
        cost.fake_activations(counted, BATCH, None)


@pytest.mark.parametrize("settings", [AdamW(), AdamW(fused=False), SGD(), SGD(momentum=0.0)])
def test_the_state_of_an_optimizer(settings: Any) -> None:
    model = Stack()
    found = replicated_layout(on_meta())
    groups = [{"params": [p], "weight_decay": 0.0} for p in model.parameters() if p.requires_grad]
    optimizer = settings.build(groups, 1e-3)
    model(**BATCH)["loss"].backward()
    optimizer.step()
    assert cost.optimizer_bytes(settings.build, found.optimized) == cost.state_bytes(optimizer)


def test_what_one_process_alone_keeps() -> None:
    model = Stack()
    model(**BATCH)["loss"].backward()
    found = replicated_layout(on_meta())
    own: Mapping[str, Any] = dict(model.named_parameters())
    assert found.parameters == sum(t.nbytes for t in [*own.values(), model.scale])
    assert found.gradients == sum(p.grad.nbytes for p in own.values() if p.grad is not None)
    assert found.gathered == 0


def test_the_sum_and_the_averages() -> None:
    found = replicated_layout(on_meta())
    kept = cost.SavedActivations(5, recomputed=2, largest_unit=3, weight_copies=7, batch=11)
    whole = cost.footprint(found, kept, 13, True, False)
    assert whole.averages == found.gradients
    assert whole.total == found.parameters + 2 * found.gradients + 13 + 5 + 7 + 11
    assert whole.to_dict()["total"] == whole.total
