"""What is not parity: draws, company, units, freezing, continuing a chunk, errors, learning."""

from __future__ import annotations

import pytest
import torch
from fluxvla_models.guidance import Guide
from fluxvla_pi.pi0 import PI0FlowMatching
from fluxvla_pi.pi05 import PI05FlowMatching

from fluxvla_core.errors import ConfigError
from fluxvla_core.training.cost import fake, fake_activations, saved_activations

from .oracles.pi_inputs import ACTIONS, BATCH, HORIZON, SIZES
from .tiny import acting_batch, model_of, relative, training_batch

FAMILIES = ("pi0", "pi05")


@pytest.fixture(scope="module", params=FAMILIES)
def model(request):
    torch.manual_seed(0)
    made = model_of(request.param)
    for parameter in made.parameters():  # adaptive normalisation begins with zeros
        if parameter.requires_grad:
            torch.nn.init.normal_(parameter, std=0.1)
    return made


def drawn(draws):
    """A batch with several draws, and the same samples with one each."""
    batch = training_batch()
    torch.manual_seed(1)
    batch["noise"] = torch.randn(BATCH, draws, HORIZON, ACTIONS)
    batch["time"] = torch.rand(BATCH, draws)
    return batch, [
        {**batch, "noise": batch["noise"][:, k : k + 1], "time": batch["time"][:, k : k + 1]}
        for k in range(draws)
    ]


def test_several_draws_are_as_many_batches_with_one(model):
    batch, parts = drawn(3)
    with torch.no_grad():
        found = model(**batch)
        each = [model(**part) for part in parts]
    for name in ("loss", "sample_losses"):
        mean = torch.stack([part[name] for part in each]).mean(0)
        torch.testing.assert_close(found[name], mean, rtol=1e-5, atol=1e-6)


def test_a_sample_does_not_depend_on_its_company(model):
    batch = training_batch()
    with torch.no_grad():
        found = model(**batch)["sample_losses"]
        alone = model(**{key: value[1:2] for key, value in batch.items()})["loss"]
        chunk = model.predict_action(**acting_batch())
        one = model.predict_action(**{key: v[1:2] for key, v in acting_batch().items()})
    assert found[1].item() == pytest.approx(alone.item(), rel=1e-5)
    assert relative(one, chunk[1:2]) < 1e-5


def test_padding_and_cameras_that_are_not_there_do_not_matter(model):
    batch = acting_batch()
    other = {
        **batch,
        "images": batch["images"].clone(),
        "lang_tokens": batch["lang_tokens"].clone(),
    }
    other["images"][1, 3:] = 1.0
    other["lang_tokens"][~batch["lang_masks"]] = 7
    with torch.no_grad():
        assert torch.equal(model.predict_action(**batch), model.predict_action(**other))


def test_no_masks_of_cameras_means_that_all_are_there(model):
    batch = acting_batch()
    given = {**batch, "img_masks": torch.ones_like(batch["img_masks"])}
    del batch["img_masks"]
    with torch.no_grad():
        assert torch.equal(model.predict_action(**batch), model.predict_action(**given))


def test_the_prefix_is_computed_once(model):
    calls = []
    handles = [
        part.register_forward_hook(lambda module, *_: calls.append(module))
        for part in (
            model.vision_backbone,
            model.llm_backbone.layers[0],
            model.llm_expert.layers[0],
        )
    ]
    try:
        with torch.no_grad():
            model.predict_action(**acting_batch())
    finally:
        for handle in handles:
            handle.remove()
    assert calls.count(model.vision_backbone) == calls.count(model.llm_backbone.layers[0]) == 1
    assert calls.count(model.llm_expert.layers[0]) == model.num_steps == 10


def test_actions_beyond_the_end_count_as_0(model):
    batch = training_batch()
    masks = torch.ones(BATCH, HORIZON)
    with torch.no_grad():
        whole = model(**batch, action_masks=masks)["loss"]
        masks[0, 3:] = 0
        found = model(**batch, action_masks=masks)
        # The noised chunk is an input, so only its masked targets are free: where all is noise.
        free = {**batch, "time": torch.zeros(BATCH, 1), "actions": batch["actions"].clone()}
        one = model(**free, action_masks=masks)["loss"]
        free["actions"][0, 3:] = 9.0
        other = model(**free, action_masks=masks)["loss"]
    assert whole.item() == pytest.approx(model(**batch)["loss"].item())
    assert found["loss"] < whole
    assert torch.equal(one, other)


def test_continuing_a_chunk_is_guided_inpainting(model):
    """``Guide`` with the clean chunk that the velocity points at, time from noise to data."""
    batch = acting_batch()
    torch.manual_seed(2)
    old = torch.randn(BATCH, HORIZON, ACTIONS)
    weights = torch.tensor([1.0, 1.0, 0.6, 0.2, 0.0]).expand(BATCH, HORIZON)
    frozen, most = torch.tensor([2, 0, 1]), torch.tensor([5.0, 5.0, 2.0])
    more = {
        "prev_actions": old,
        "prefix_weights": weights,
        "prefix_len": frozen,
        "max_guidance_weight": most,
    }
    with torch.no_grad():
        found = model.predict_action(**batch, **more)
        free = model.predict_action(**batch)

        prefix = model.embed_prefix(
            batch["images"], batch["img_masks"], batch["lang_tokens"], batch["lang_masks"]
        )
        known = model._keys_and_values(prefix)
        guide, x = Guide(old, weights, frozen, most), batch["noise"]
        for step in range(10):
            t = step / 10

            def velocity(y, t=t):
                tau = torch.full((BATCH,), 1 - t)
                return model._velocity(y, tau, batch["states"], prefix.real, known)

            def clean(y, t=t, velocity=velocity):
                return y - (1 - t) * velocity(y)

            _, pull = guide.pull(clean, x, t)
            x = x + (-velocity(x) + pull) / 10
    expected = guide.freeze(x)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert torch.equal(found[0, :2], old[0, :2])
    assert (found - old)[:, :3].abs().mean() < (free - old)[:, :3].abs().mean()


def test_padding_that_the_loss_leaves_out_is_not_pulled(model):
    batch = acting_batch()
    torch.manual_seed(2)
    old = torch.randn(BATCH, HORIZON, ACTIONS)
    more = {
        "prefix_weights": torch.ones(BATCH, HORIZON),
        "prefix_len": torch.full((BATCH,), 2),
        "max_guidance_weight": torch.full((BATCH,), 5.0),
    }
    other = old.clone()
    other[..., 3:] = 9.0
    model.ori_action_dim = 3
    try:
        with torch.no_grad():
            found = model.predict_action(**batch, prev_actions=old, **more)
            assert torch.equal(model.predict_action(**batch, prev_actions=other, **more), found)
    finally:
        model.ori_action_dim = None
    assert found.shape == (BATCH, HORIZON, ACTIONS)
    assert torch.equal(found[:, :2, :3], old[:, :2, :3])


@pytest.fixture
def conditioned(model):
    model.prefix_conditioning = True
    yield model
    model.prefix_conditioning = False


def test_a_prefix_of_no_actions_changes_nothing(model):
    batch, _ = drawn(2)
    with torch.no_grad():
        free = model(**batch)["loss"]
        model.prefix_conditioning = True
        try:
            found = model(**batch, prefix_len=torch.zeros(BATCH, 2, dtype=torch.int64))["loss"]
        finally:
            model.prefix_conditioning = False
    torch.testing.assert_close(found, free)


def test_actions_of_a_prefix_are_given_without_noise_and_not_counted(conditioned):
    batch, _ = drawn(2)
    length = torch.tensor([[2, 0], [5, 1], [3, 4]])
    given = torch.arange(HORIZON) < length[..., None]
    with torch.no_grad():
        found = conditioned(**batch, prefix_len=length)
        other = {**batch, "noise": torch.where(given[..., None], 9.0, batch["noise"])}
        again = conditioned(**other, prefix_len=length)
        torch.testing.assert_close(again["loss"], found["loss"])
        # By hand: the velocity at what is half known, errors of the rest over all.
        prefix = conditioned.embed_prefix(
            batch["images"], batch["img_masks"], batch["lang_tokens"], batch["lang_masks"]
        )
        known = conditioned._keys_and_values(prefix)
        total = 0.0
        for k in range(2):
            tau = torch.where(given[:, k], 0.0, 1 - batch["time"][:, k : k + 1])
            x = torch.lerp(batch["actions"], batch["noise"][:, k], tau[..., None])
            velocity = conditioned._velocity(x, tau, batch["states"], prefix.real, known)
            errors = (batch["noise"][:, k] - batch["actions"] - velocity).square()
            total += (errors * ~given[:, k, :, None]).sum().item()
    count = batch["noise"].numel()
    assert found["loss"].item() == pytest.approx(total / count, rel=1e-5)


def test_a_chunk_continues_by_its_prefix(conditioned):
    batch = acting_batch()
    torch.manual_seed(4)
    old, frozen = torch.randn(BATCH, HORIZON, ACTIONS), torch.tensor([2, 0, 3])
    more = {
        "prev_actions": old,
        "prefix_weights": torch.ones(BATCH, HORIZON),
        "prefix_len": frozen,
        "max_guidance_weight": torch.full((BATCH,), 5.0),
    }
    with torch.no_grad():
        found = conditioned.predict_action(**batch, **more)
        free = conditioned.predict_action(**batch)
        later = {**more, "prev_actions": old.clone()}
        later["prev_actions"][0, 2:] = 9.0
        assert torch.equal(conditioned.predict_action(**batch, **later), found)
    assert torch.equal(found[0, :2], old[0, :2])
    assert torch.equal(found[2, :3], old[2, :3])
    torch.testing.assert_close(found[1], free[1])
    assert not torch.allclose(found[0, 2:], free[0, 2:])


def test_prefixes_and_the_model_belong_together(model, conditioned):
    with pytest.raises(ConfigError, match="prefix_conditioning is True, and the batch has no"):
        conditioned(**training_batch())
    model.prefix_conditioning = False
    length = torch.zeros(BATCH, 1, dtype=torch.int64)
    with pytest.raises(ConfigError, match="prefix_conditioning is False, and the batch has a"):
        model(**training_batch(), prefix_len=length)


def test_units_are_pairs_that_share_an_attention(model):
    units = model.fsdp_units()
    pairs = [unit for unit in units if isinstance(unit, tuple)]
    assert pairs == list(zip(model.llm_backbone.layers, model.llm_expert.layers, strict=True))
    assert units[: len(units) - len(pairs)] == list(model.vision_backbone.layers)


def test_what_the_loss_does_not_reach_is_not_trained(model):
    model.zero_grad()
    model(**training_batch())["loss"].backward()
    for name, parameter in model.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name
    last = len(model.llm_backbone.layers) - 1
    frozen = {name for name, p in model.named_parameters() if not p.requires_grad}
    layer = f"llm_backbone.layers.{last}"
    assert frozen == {
        f"{layer}.self_attn.q_proj.weight",
        f"{layer}.self_attn.o_proj.weight",
        f"{layer}.post_attention_layernorm.weight",
        *(f"{layer}.mlp.{part}_proj.weight" for part in ("gate", "up", "down")),
        "llm_backbone.norm.weight",
    }


@pytest.mark.parametrize("family", FAMILIES)
def test_parts_can_be_frozen(family):
    model = model_of(family, freeze_vision_backbone=True, freeze_llm_backbone=True)
    trained = {name.split(".")[0] for name, p in model.named_parameters() if p.requires_grad}
    assert trained.isdisjoint({"vision_backbone", "projector", "llm_backbone"})
    assert {"llm_expert", "action_in_proj", "action_out_proj"} <= trained
    model(**training_batch())["loss"].backward()


def test_bf16_autocast_stays_near(model):
    with torch.no_grad():
        exact = model.predict_action(**acting_batch())
        with torch.autocast("cpu", torch.bfloat16):
            found = model.predict_action(**acting_batch())
            loss = model(**training_batch())["loss"]
    assert found.dtype == loss.dtype == torch.float32
    assert relative(found, exact) < 5e-2


@pytest.mark.parametrize("family", FAMILIES)
def test_it_learns_a_batch(family):
    torch.manual_seed(3)
    model = model_of(family)
    batch = training_batch()
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], 3e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        batch["noise"] = torch.randn(BATCH, 4, HORIZON, ACTIONS)
        batch["time"] = torch.rand(BATCH, 4)
        loss = model(**batch)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])


GEMMA, EXPERT = SIZES["variant"], SIZES["expert_variant"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"variant": "gemma_7b"}, "variant: 'gemma_7b' is not one of gemma_2b, gemma_300m, dummy"),
        ({"variant": {"width": 8}}, "variant: a size has width, depth, mlp_dim, heads"),
        ({"variant": {**GEMMA, "depth": 0}}, r"at least 1, got \{'depth': 0\}"),
        ({"variant": {**GEMMA, "head_dim": 7}}, "head_dim 7 even"),
        ({"expert_variant": {**EXPERT, "depth": 2}}, "depth is 3 and 2"),
        ({"expert_variant": {**EXPERT, "head_dim": 4}}, "head_dim is 8 and 4"),
        ({"expert_variant": {**EXPERT, "width": 23}}, "width 23 must be even"),
        ({"vision_variant": {**SIZES["vision_variant"], "image_size": 30}}, "image_size 30"),
        ({"num_steps": 0}, "num_steps 0"),
        ({"ori_action_dim": 9}, r"ori_action_dim 9 is not in 1..8"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        PI05FlowMatching(**{**SIZES, **settings})


def test_chunks_and_images_of_another_size_are_refused(model):
    batch = training_batch()
    with pytest.raises(ConfigError, match=r"actions are \(4, 8\) .* chunks \(5, 8\)"):
        model(**{**batch, "actions": batch["actions"][:, :4]})
    with pytest.raises(ConfigError, match=r"noise are \(5, 7\)"):
        model.predict_action(**{**acting_batch(), "noise": torch.zeros(BATCH, 5, 7)})
    with pytest.raises(ConfigError, match="images of 3 x 28 x 28, got 3 x 28 x 27"):
        model.predict_action(**{**acting_batch(), "images": batch["images"][..., 1:]})


def test_named_sizes():
    with torch.device("meta"):
        model = PI0FlowMatching(
            variant="dummy", expert_variant="dummy", vision_variant="dummy", vocab_size=64
        )
    assert model.action_shape == (50, 32)
    assert len(model.llm_backbone.layers) == len(model.llm_expert.layers) == 4


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("dtype", [None, torch.bfloat16], ids=["float32", "bfloat16"])
def test_its_activations_are_counted_without_memory(family, dtype):
    with torch.device("meta"):
        bare = model_of(family)
    batch = training_batch()
    told = fake_activations(fake(bare), batch, dtype)
    found = saved_activations(model_of(family), batch, dtype)
    assert told.activations == pytest.approx(found.activations, rel=0.01)
    assert told.recomputed == pytest.approx(found.recomputed, rel=0.01)
    assert told.weight_copies == found.weight_copies
