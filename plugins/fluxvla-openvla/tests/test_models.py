from __future__ import annotations

import pytest
import torch
from fluxvla_openvla.language import attention_mask, hidden_states, positions, split_prompt
from fluxvla_openvla.openvla import OpenVLA
from fluxvla_openvla.openvla_oft import OpenVLAOFT

from fluxvla_core.errors import ConfigError
from tests.training.adapters import OWN, idle_parameters

from . import tiny


def make(kind, **settings):
    torch.manual_seed(0)
    return kind(**{**tiny.SMALL, **settings}).eval()


def observation(count=1, size=2):
    torch.manual_seed(1)
    tokens = torch.tensor([[1, 40, 60, 7, 9, 0], [1, 41, 60, 8, 0, 0]])[:size]
    return {
        "images": torch.rand(size, 3 * count, 28, 28) * 2 - 1,
        "lang_tokens": tokens,
        "lang_masks": tokens != 0,
    }


def oft_batch(model, size=2):
    batch = observation(model.num_images, size)
    batch["actions"] = torch.rand(size, model.horizon, model.action_dim) * 2 - 1
    batch["states"] = torch.rand(size, model.state_dim)
    if model.head == "diffusion":
        batch["noise"] = torch.randn(size, 1, model.horizon, model.action_dim)
        batch["time"] = torch.randint(0, 50, (size, 1))
    return batch


def test_prompts_are_moved_next_to_the_actions():
    seen = observation()
    for flipped in (False, True):
        tokens, masks = seen["lang_tokens"], seen["lang_masks"]
        if flipped:
            tokens, masks = tokens.clone(), masks.clone()
            tokens[1], masks[1] = tokens[1].roll(2), masks[1].roll(2)
        prompt = split_prompt(tokens, masks)
        assert prompt.first.tolist() == [[1], [1]]
        assert prompt.rest[prompt.mask].tolist() == [40, 60, 7, 9, 41, 60, 8]
        assert prompt.mask.tolist() == [[False, True, True, True, True], [False] * 2 + [True] * 3]


def test_who_attends_to_whom_and_where_tokens_stand():
    real = torch.tensor([[True, False, True]])
    assert positions(real).tolist() == [[0, 0, 1]]
    assert attention_mask(real, causal=False)[0, 0].tolist() == [[True, False, True]] * 3
    assert attention_mask(real, causal=True)[0, 0].tolist() == [
        [True, False, False],
        [True, False, False],
        [True, False, True],
    ]


@pytest.mark.parametrize("side", ["left", "right"])
def test_padding_does_not_matter(side):
    model, batch = make(OpenVLA), observation()
    longer = {"images": batch["images"]}
    for key in ("lang_tokens", "lang_masks"):
        pad = torch.zeros(2, 3, dtype=batch[key].dtype)
        parts = [pad, batch[key]] if side == "left" else [batch[key], pad]
        longer[key] = torch.cat(parts, 1)
    actions = torch.rand(2, 1, 7) * 2 - 1
    losses = [model(**b, actions=actions)["sample_losses"] for b in (batch, longer)]
    torch.testing.assert_close(losses[0], losses[1])
    assert torch.equal(model.predict_action(**batch), model.predict_action(**longer))


def test_decoding_with_a_cache_equals_decoding_anew():
    model, batch = make(OpenVLA, action_dim=5), observation()
    found = model.action_tokens.encode(model.predict_action(**batch)[:, 0])
    # The probability of each token given the ones before is greatest where it was chosen.
    embeddings, real = model._sequence(
        batch["images"], split_prompt(batch["lang_tokens"], batch["lang_masks"])
    )
    embeddings = torch.cat([embeddings, model.embed(found)], 1)
    real = torch.cat([real, torch.ones(2, 5, dtype=torch.bool)], 1)
    states = hidden_states(model.language_model, embeddings, real, causal=True)[:, -6:-1]
    logits = model.language_model.lm_head(states)[..., 128:384]
    again = model.action_tokens.decode(logits.argmax(-1) + 128)
    assert torch.equal(again, model.action_tokens.decode(found))


def test_a_model_in_bfloat16_has_the_same_bins_and_steps():
    actions = torch.linspace(-1, 1, 7).expand(2, 1, 7)
    model = make(OpenVLA)
    expected = model.action_tokens.encode(actions)
    assert torch.equal(model.bfloat16().action_tokens.encode(actions), expected)
    # There is nothing else to round but Llama's rotary frequencies, which are transformers' own.
    diffusion = make(OpenVLAOFT, head="diffusion")
    assert all("rotary_emb" in name for name, _ in diffusion.named_buffers())


def test_only_tokens_of_actions_are_chosen():
    model, batch = make(OpenVLA), observation()
    with torch.no_grad():
        # The end of text, and the padding of the embedding, are the likeliest of all.
        model.language_model.lm_head.weight[[2, 400]] = (
            50 * model.language_model.lm_head.weight[200]
        )
    found = model.predict_action(**batch)
    tokens = model.action_tokens.encode(found)
    assert found.shape == (2, 1, 7)
    assert ((tokens >= 128) & (tokens < 384)).all()


@pytest.mark.parametrize("stop", [True, False])
def test_the_stop_token_is_learnt_or_not(stop):
    model, batch = make(OpenVLA, predict_stop_token=stop), observation()
    model(**batch, actions=torch.zeros(2, 1, 7))["loss"].backward()
    grad = model.language_model.lm_head.weight.grad
    # Only the right answer's row is pulled towards the state.
    before = grad[2].clone()
    model.zero_grad()
    other = make(OpenVLA, predict_stop_token=not stop)
    other(**batch, actions=torch.zeros(2, 1, 7))["loss"].backward()
    assert (before.norm() > other.language_model.lm_head.weight.grad[2].norm()) == stop


def test_masked_actions_do_not_matter():
    model = make(OpenVLAOFT, horizon=3)
    batch = oft_batch(model)
    masks = torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    other = {**batch, "actions": batch["actions"].clone()}
    other["actions"][0, 2] = 9.0
    found, changed = (model(**b, action_masks=masks)["loss"] for b in (batch, other))
    assert torch.equal(found, changed)
    assert not torch.equal(model(**batch)["loss"], model(**other)["loss"])


@pytest.mark.parametrize("settings", [{}, {"head": "diffusion"}, {"use_film": True}])
def test_a_samples_loss_does_not_depend_on_its_company(settings):
    model = make(OpenVLAOFT, horizon=3, **settings)
    batch = oft_batch(model)
    together = model(**batch)
    for row in range(2):
        alone = model(**{k: v[row : row + 1] for k, v in batch.items()})
        torch.testing.assert_close(together["sample_losses"][row], alone["loss"].detach())
    torch.testing.assert_close(together["sample_losses"].mean(), together["loss"].detach())


def test_a_model_without_a_state_takes_none():
    model = make(OpenVLAOFT, horizon=2, state_dim=0)
    assert "states" not in model.batch_keys()
    assert not any("proprio" in name for name in model.state_dict())
    batch = oft_batch(model)
    del batch["states"]
    model(**batch)["loss"].backward()


def test_what_the_models_ask_a_batch_for():
    plain = {"images": True, "lang_tokens": True, "lang_masks": True, "actions": True}
    assert make(OpenVLA).batch_keys() == {**plain, "action_masks": False}
    diffusion = make(OpenVLAOFT, head="diffusion").batch_keys()
    assert diffusion == {
        **plain,
        "action_masks": False,
        "states": True,
        "noise": True,
        "time": True,
    }


@pytest.mark.parametrize(
    ("kind", "settings"),
    [(OpenVLA, {}), (OpenVLAOFT, {}), (OpenVLAOFT, {"head": "diffusion", "use_film": True})],
)
def test_every_trainable_parameter_is_used_and_units_do_not_overlap(kind, settings):
    model = make(kind, **settings)
    batch = (
        oft_batch(model)
        if kind is OpenVLAOFT
        else {**observation(), "actions": torch.zeros(2, 1, 7)}
    )
    model(**batch)["loss"].backward()
    unused = [n for n, p in model.named_parameters() if p.requires_grad and p.grad is None]
    assert unused == []
    seen = [id(p) for unit in model.fsdp_units() for p in unit.parameters()]
    assert len(seen) == len(set(seen))
    assert all(p.requires_grad for unit in model.fsdp_units() for p in unit.parameters())


@pytest.mark.parametrize(
    ("kind", "settings", "rate"),
    [(OpenVLA, {}, 3e-3), (OpenVLAOFT, {}, 3e-3), (OpenVLAOFT, {"head": "diffusion"}, 3e-3)],
)
def test_it_learns_one_batch(kind, settings, rate):
    model = make(kind, **settings)
    batch = (
        oft_batch(model)
        if kind is OpenVLAOFT
        else {**observation(), "actions": torch.rand(2, 1, 7) * 2 - 1}
    )
    used = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(used, rate, weight_decay=0.0)
    first = None
    for _ in range(100):
        optimizer.zero_grad()
        loss = model(**batch)["loss"]
        loss.backward()
        optimizer.step()
        first = loss.item() if first is None else first
    assert loss.item() < 0.5 * first
    if kind is OpenVLA:
        found = model.predict_action(**observation())
        assert (found - batch["actions"]).abs().mean() < 0.3


@pytest.mark.parametrize(
    ("kind", "settings", "words"),
    [
        (OpenVLA, {"action_dim": 0}, "OpenVLA: action_dim must be at least 1, got 0"),
        (OpenVLA, {"dino": {"widht": 3}}, "OpenVLA: dino has no 'widht'; it has width"),
        (OpenVLA, {"dino": {"width": "a"}}, "dino.width must be of type int, got 'a'"),
        (OpenVLA, {"language": 3}, "language must be a table, got 3"),
        (OpenVLA, {"image_size": 30}, "images of 30 pixels, patches of 14"),
        (OpenVLA, {"siglip": {"num_heads": 5}}, "width 1152, num_heads 5"),
        (OpenVLA, {"language": {"text_vocab_size": 40000}}, "text_vocab_size 40000 must be above"),
        (OpenVLAOFT, {"head": "l2"}, "head 'l2' is not one of l1, diffusion"),
        (OpenVLAOFT, {"num_inference_steps": 51}, "must be between 1 and num_train_steps 50"),
    ],
)
def test_parameters_that_cannot_be(kind, settings, words):
    with pytest.raises(ConfigError, match=words):
        kind(**settings)


def test_batches_that_do_not_fit():
    model = make(OpenVLAOFT, horizon=3)
    batch = oft_batch(model)
    for key, value, words in (
        ("actions", torch.zeros(2, 3, 6), r"\(3, 6\), the model has horizon 3 and action_dim 7"),
        ("images", batch["images"][:, :3], "2 x 3 planes of 28 x 28 are expected"),
        ("states", torch.zeros(2, 6), r"states have shape \(2, 6\), state_dim is 8"),
    ):
        with pytest.raises(ConfigError, match=words):
            model(**{**batch, key: value})


@pytest.mark.parametrize("head", [None, "l1", "diffusion"])
def test_every_adapter_of_the_models_own_layers_trains(head):
    pytest.importorskip("peft")
    if head is None:
        model = make(OpenVLA)
        batch = {**observation(), "actions": torch.rand(2, 1, 7) * 2 - 1}
    else:
        model = make(OpenVLAOFT, head=head)
        batch = oft_batch(model)
    names = {name for name, _ in model.named_modules()}
    assert idle_parameters(model, OWN, batch) == []
    trained = {name for name, p in model.named_parameters() if p.requires_grad}
    layers = {name.partition(".lora_")[0] for name in trained if ".lora_" in name}
    assert layers <= names
    assert ("language_model.lm_head" in layers) == (head is None)
    assert not any(".blocks.2." in name for name in layers)  # the last, which is not used
    assert any("action_head" in name for name in trained) == (head is not None)
