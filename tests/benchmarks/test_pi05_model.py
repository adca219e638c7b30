"""The network of the benchmark for GPUs: its size, its operations, and who sees what."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks import _pi05_attention
from benchmarks._pi05_attention import Places, attend, first, first_packed
from benchmarks._pi05_model import SIZES, BenchPi05, ExpertLayer, LanguageLayer, Size
from fluxvla_core.training.cost import on_meta, training_flops
from fluxvla_core.training.model import units_of

S = SIZES["tiny"]
BATCH = 3


@pytest.fixture
def model() -> BenchPi05:
    torch.manual_seed(0)
    return BenchPi05("tiny")


@pytest.fixture
def batch() -> dict[str, Tensor]:
    rng = torch.Generator().manual_seed(1)
    shape = (BATCH, 3 * S.cameras, S.image_size, S.image_size)
    chunk = (BATCH, S.actions, S.action_dim)
    return {
        "images": torch.randint(0, 256, shape, generator=rng, dtype=torch.uint8),
        "lang_tokens": torch.randint(0, S.words, (BATCH, S.prompt), generator=rng),
        "lang_masks": torch.arange(S.prompt) < torch.tensor([[4], [S.prompt], [7]]),
        "actions": torch.randn(chunk, generator=rng),
        "noise": torch.randn(chunk, generator=rng),
        "time": torch.rand(BATCH, generator=rng),
    }


def test_the_full_size() -> None:
    full = BenchPi05(device="meta")
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in children(full)}
    assert sum(p.numel() for p in full.parameters()) == pytest.approx(3.3e9, rel=0.03)
    # As the reports give them: So400m; Gemma-2B without its table of words; the expert's 300 M,
    # with adaptive norms of three vectors for each of two norms a layer.
    assert counts["vision"] == pytest.approx(0.41e9, rel=0.02)
    assert counts["language"] == pytest.approx(1.98e9, rel=0.01)
    norms = 18 * 2 * 3 * (1024**2 + 1024)
    assert counts["expert"] - norms == pytest.approx(0.311e9, rel=0.01)
    assert full.words.shape == (257152, 2048)
    assert full.size.prefix == 2 * 256 + 200


def children(model: BenchPi05) -> list[tuple[str, torch.nn.Module]]:
    return list(model.named_children())


def test_layers_of_the_same_number_are_one_unit(model: BenchPi05) -> None:
    units = units_of(model)
    assert [len(unit) for unit in units] == [1] * S.vision_layers + [2] * S.layers
    for number, (language, expert) in enumerate(units[S.vision_layers :]):
        assert language is model.language[number]
        assert expert is model.expert[number]
        assert isinstance(language, LanguageLayer)
        assert isinstance(expert, ExpertLayer)


def operations(s: Size) -> int:
    """Of one sample's forward and backward pass, by the shapes alone."""
    seen, vision = s.cameras * s.patches, s.vision_width
    joined, last = s.heads * s.head_width, s.actions
    # Products that need no gradient of their input: one backward product instead of two.
    edge = seen * 3 * s.patch**2 * vision + last * s.action_dim * s.expert_width
    edge += s.expert_width**2
    inner = s.vision_layers * seen * (4 * vision**2 + 2 * vision * s.vision_inner)
    inner += s.vision_layers * 2 * seen * s.patches * vision + seen * vision * s.width
    qkv = joined + 2 * s.head_width
    inner += s.layers * s.prefix * s.width * qkv
    each = s.prefix * (joined * s.width + 3 * s.width * s.inner) + 2 * s.prefix**2 * joined
    inner += (s.layers - 1) * each
    each = last * (s.expert_width * (qkv + joined) + 3 * s.expert_width * s.expert_inner)
    each += 2 * last * (s.prefix + last) * joined + 2 * 3 * s.expert_width**2
    inner += s.layers * each + 3 * s.expert_width**2
    inner += s.expert_width**2 + last * s.expert_width * s.action_dim
    return 2 * (2 * edge + 3 * inner)


@pytest.mark.parametrize("masks", [True, False])
def test_the_runners_count_of_operations_is_that_of_the_shapes(
    masks: bool, model: BenchPi05, batch: dict[str, Tensor]
) -> None:
    if not masks:
        del batch["lang_masks"]
    assert training_flops(on_meta(model), batch) == BATCH * operations(S)


def test_the_full_size_is_ten_teraflops_a_sample() -> None:
    """Six for each weight and token that passes it is most of it: 9.4 of 9.7."""
    full = Size()
    tokens = full.cameras * full.patches
    rough = 6 * (0.4115e9 * tokens + 1.982e9 * 17 / 18 * full.prefix + 0.311e9 * full.actions)
    assert operations(full) == pytest.approx(9.66e12, rel=0.01)
    assert rough == pytest.approx(operations(full), rel=0.06)


def test_padding_is_not_seen(model: BenchPi05, batch: dict[str, Tensor]) -> None:
    loss = model(**batch)["loss"].detach()
    changed = torch.where(batch["lang_masks"], batch["lang_tokens"], 0)
    torch.testing.assert_close(model(**{**batch, "lang_tokens": changed})["loss"].detach(), loss)
    seen = torch.where(batch["lang_masks"], 0, batch["lang_tokens"])
    other = model(**{**batch, "lang_tokens": seen})["loss"].detach()
    assert float((other - loss).abs()) > 1e-4


def test_a_shorter_prompt_is_a_prompt_without_padding(
    model: BenchPi05, batch: dict[str, Tensor]
) -> None:
    whole = {k: v[1:2] for k, v in batch.items()}
    with_masks = model(**whole)["loss"]
    del whole["lang_masks"]
    torch.testing.assert_close(model(**whole)["loss"], with_masks)


def test_images_and_prompt_do_not_see_the_actions(
    model: BenchPi05, batch: dict[str, Tensor]
) -> None:
    found: list[Tensor] = []
    model.language[-1].register_forward_hook(lambda _, __, out: found.append(out[1]))
    model(**batch)
    model(**{**batch, "actions": -batch["actions"], "time": 1 - batch["time"]})
    assert torch.equal(*found)


def test_everything_trains_but_what_nothing_reads(
    model: BenchPi05, batch: dict[str, Tensor]
) -> None:
    model(**batch)["loss"].backward()
    idle = {name for name, p in model.named_parameters() if p.grad is None}
    last = f"language.{S.layers - 1}"
    assert idle == {f"{last}.{part}.weight" for part in ("out", "up", "down", "norms.1")}
    still = {n for n, p in model.named_parameters() if p.grad is not None and not p.grad.any()}
    assert still == set()


def by_sequence(
    query: Tensor, key: Tensor, value: Tensor, rows: Tensor, keys: Tensor, *longest: int
) -> Tensor:
    """What torch's kernel for sequences of different lengths computes, one after the other."""
    out = torch.zeros_like(query)
    for a, b, c, d in zip(rows[:-1], rows[1:], keys[:-1], keys[1:], strict=True):
        assert b - a <= longest[0]
        assert d - c <= longest[1]
        one = (x[None, :, 0] for x in (query[a:b], key[c:d], value[c:d]))
        out[a:b, 0] = F.scaled_dot_product_attention(*one)[0]
    return out


@pytest.mark.parametrize("among_themselves", [True, False])
def test_packed_sequences_are_a_mask(
    among_themselves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_pi05_attention, "varlen_attn", by_sequence)
    counts, keys, heads, width = torch.tensor([2, 6, 5]), 6, 4, 8
    length = keys if among_themselves else 3
    query = torch.randn(len(counts), length, heads, width)
    key, value = torch.randn(2, len(counts), keys, width).unbind()
    rows = counts * heads if among_themselves else length * heads
    seen = first_packed(counts, keys, rows, length * heads)
    assert seen.queries is not None
    assert seen.queries.dtype == torch.int32
    packed = attend(query, key, value, seen)
    masked = attend(query, key, value, first(counts, keys))
    kept = torch.arange(length) < (counts[:, None] if among_themselves else length)
    kept = kept.expand(len(counts), length)
    torch.testing.assert_close(packed[kept], masked[kept])


def test_heads_are_rows_that_share_keys() -> None:
    query, (key, value) = torch.randn(2, 3, 4, 8), torch.randn(2, 2, 5, 8)
    shared = (x[:, None].expand(-1, 4, -1, -1) for x in (key, value))
    expected = F.scaled_dot_product_attention(query.transpose(1, 2), *shared)
    found = attend(query, key, value, first(torch.tensor([5, 5]), 5))
    torch.testing.assert_close(found, expected.transpose(1, 2).flatten(2))


def test_places_turn_by_distance_alone() -> None:
    x, y = torch.randn(2, 8)

    def product(i: int, j: int) -> Tensor:
        one, other = (Places.of(torch.tensor([[k]]), 8, torch.float32) for k in (i, j))
        return (one.turn(x[None, None, None]) * other.turn(y[None, None, None])).sum()

    torch.testing.assert_close(product(2, 5), product(40, 43), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(product(7, 7), (x * y).sum())


def test_an_unknown_way_of_attention_is_refused() -> None:
    with pytest.raises(ValueError, match="attention 'flash' is not one of sdpa, packed"):
        BenchPi05("tiny", attention="flash")
