"""What GR00T promises besides equality with the reference: rows by themselves, errors, guidance."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_gr00t.action_head import GR00TActionHead
from fluxvla_gr00t.eagle import EagleBackbone
from fluxvla_gr00t.gr00t import GR00T
from fluxvla_gr00t.image_tokens import image_token_of
from fluxvla_gr00t.qwen3_vl import Qwen3VLBackbone

from fluxvla_core.errors import ConfigError
from tests.training.adapters import OWN, adapted, shipped

from .gr00t_sizes import PLACE, TINY_HEAD, TINY_N15, TINY_N17, published, tiny
from .test_gr00t_parity import batch, to_act

VERSIONS = ["n1.5", "n1.7"]


def without_padding(inputs, row, padded):
    alone = {key: value[row : row + 1] for key, value in inputs.items()}
    for key in ("lang_tokens", "lang_masks"):
        alone[key] = alone[key][:, padded:]
    return alone


@pytest.mark.parametrize("version", VERSIONS)
def test_a_row_is_what_it_is_alone_and_without_padding(version):
    model, inputs = tiny(version), to_act(batch(version, padded=True))
    with torch.no_grad():
        together = model.predict_action(**inputs)
        alone = model.predict_action(**without_padding(inputs, 1, 3))
        as_published = tiny(version, attend_padding=True).predict_action(**inputs)
    torch.testing.assert_close(together[1:], alone, rtol=1e-5, atol=1e-5)
    assert (as_published[1] - together[1]).abs().max() > 1e-4


@pytest.mark.parametrize("version", VERSIONS)
def test_the_mean_of_the_rows_losses_is_the_loss(version):
    model, inputs = tiny(version, ori_action_dim=4), batch(version, padded=True, masked=True)
    inputs["noise"] = torch.cat([inputs["noise"], inputs["noise"].flip(0)], dim=1)
    inputs["time"] = torch.cat([inputs["time"], inputs["time"] / 2], dim=1)
    whole = model(**inputs)
    rows = [model(**without_padding(inputs, row, 0))["loss"] for row in range(2)]
    torch.testing.assert_close(whole["sample_losses"], torch.stack(rows).detach())
    torch.testing.assert_close(whole["loss"], torch.stack(rows).mean())


@pytest.mark.parametrize("version", VERSIONS)
def test_what_an_absent_image_shows_does_not_matter(version):
    model, inputs = tiny(version), to_act(batch(version))
    inputs["img_masks"] = torch.tensor([[True, True], [True, False]])
    other = {**inputs, "images": inputs["images"].clone()}
    other["images"][1, 3:] = 3.0
    with torch.no_grad():
        first, second = model.predict_action(**inputs), model.predict_action(**other)
        seen = model.predict_action(**{**inputs, "img_masks": None})
    assert torch.equal(first, second)
    assert (first[1] - seen[1]).abs().max() > 1e-4


@pytest.mark.parametrize("version", VERSIONS)
def test_images_words_state_time_and_embodiment_all_matter(version):
    model, inputs = tiny(version), to_act(batch(version))
    changes = {
        "images": inputs["images"] + 0.5,
        "lang_tokens": torch.where(inputs["lang_tokens"] == PLACE, PLACE, 3),
        "states": inputs["states"] + 0.5,
        "noise": inputs["noise"] + 0.5,
        "embodiment_ids": torch.tensor([1, 1]),
    }
    with torch.no_grad():
        first = model.predict_action(**inputs)
        for key, value in changes.items():
            found = model.predict_action(**{**inputs, key: value})
            assert (found - first).abs().max() > 1e-4, key


def test_batches_that_do_not_say_their_embodiment_get_the_model_s():
    inputs = to_act(batch("n1.5"))
    table = TINY_N15
    torch.manual_seed(0)
    model = GR00T(table["vlm_backbone"], table["vla_head"], embodiment_id=2).eval()
    with torch.no_grad():
        ids = torch.tensor([2, 2])
        said = model.predict_action(**{**inputs, "embodiment_ids": ids})
        found = model.predict_action(**{k: v for k, v in inputs.items() if k != "embodiment_ids"})
    assert torch.equal(said, found)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_guided_chunk_follows_the_paper(version):
    """Real-time chunking, equations 2 to 4 written out; see fluxvla_models.guidance."""
    model, inputs = tiny(version).double(), to_act(batch(version))
    inputs = {k: v.double() if v.is_floating_point() else v for k, v in inputs.items()}
    old = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 6, 5)))
    weights = torch.tensor([[1.0, 1.0, 0.6, 0.2, 0.0, 0.0]]).double().expand(2, -1)
    beta, head = 5.0, model.vla_head
    with torch.no_grad():
        found = model.predict_action(
            **inputs,
            prev_actions=old,
            prefix_weights=weights,
            prefix_len=torch.tensor([2, 1]),
            max_guidance_weight=torch.tensor([beta, beta]).double(),
        )
        backbone_output = model.vlm_backbone(
            inputs["images"], inputs["lang_tokens"], inputs["lang_masks"], None
        )
        context = head.encode_context(backbone_output)
        ids = inputs["embodiment_ids"]
        state = head.encode_states(inputs["states"], ids)
    x = inputs["noise"]
    for step in range(4):
        t = step / 4
        steps = torch.full((2,), int(1000 * t))
        leaf = x.clone().requires_grad_()
        velocity = head.velocity(leaf, steps, context, state, ids)
        clean = leaf + (1 - t) * velocity
        error = ((old - clean) * weights[..., None]).detach()
        (pull,) = torch.autograd.grad(clean, leaf, error)
        r2 = (1 - t) ** 2 / (t**2 + (1 - t) ** 2)
        strength = beta if t == 0 else min(beta, (1 - t) / (t * r2))
        x = (x + (velocity + strength * pull) / 4).detach()
    x[0, :2], x[1, :1] = old[0, :2], old[1, :1]
    torch.testing.assert_close(found, x, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_prefix_of_no_actions_changes_nothing(version):
    inputs, none = batch(version), torch.zeros(2, 1, dtype=torch.int64)
    with torch.no_grad():
        free = tiny(version)(**inputs)["loss"]
        found = tiny(version, prefix_conditioning=True)(**inputs, prefix_len=none)["loss"]
    torch.testing.assert_close(found, free)


@pytest.mark.parametrize("version", VERSIONS)
def test_actions_of_a_prefix_are_given_without_noise_and_not_counted(version):
    model = tiny(version, prefix_conditioning=True)
    inputs, length = batch(version), torch.tensor([[2, 0], [5, 1]])
    inputs["noise"] = torch.cat([inputs["noise"], inputs["noise"].flip(0)], dim=1)
    inputs["time"] = torch.cat([inputs["time"], inputs["time"] / 2], dim=1)
    given = torch.arange(6) < length[..., None]
    total = 0.0
    with torch.no_grad():
        found = model(**inputs, prefix_len=length)
        other = {**inputs, "noise": torch.where(given[..., None], 9.0, inputs["noise"])}
        torch.testing.assert_close(model(**other, prefix_len=length)["loss"], found["loss"])
        # By hand: a time for every token, and errors of what is not given over all.
        head, ids, clean = model.vla_head, inputs["embodiment_ids"], inputs["actions"]
        seen = (inputs["images"], inputs["lang_tokens"], inputs["lang_masks"], None)
        context = head.encode_context(model.vlm_backbone(*seen))
        state = head.encode_states(inputs["states"], ids)
        for k in range(2):
            time, noise = inputs["time"][:, k], inputs["noise"][:, k]
            t = torch.where(given[:, k], 1.0, time[:, None])
            x = torch.lerp(noise, clean, t[..., None])
            velocity = velocity_by_hand(
                head, x, (time * 1000).long(), given[:, k], context, state, ids
            )
            errors = (velocity - (clean - noise)).square() * ~given[:, k, :, None]
            total += (errors * inputs["action_masks"][..., None]).sum().item()
    assert found["loss"].item() == pytest.approx(total / (2 * 2 * 6 * 5), rel=1e-5)


def velocity_by_hand(head, x, steps, given, context, state, ids):
    """The published network, with what depends on the time computed token by token."""
    each = torch.where(given, 1000, steps[:, None])
    encoder = head.action_encoder
    rows = [encoder(x[:, i : i + 1], each[:, i], ids) for i in range(x.shape[1])]
    actions = torch.cat(rows, dim=1) + head.positions.weight[: x.shape[1]]
    tokens = [state, actions]
    if head.future_tokens is not None:
        tokens.insert(1, head.future_tokens.weight.expand(len(x), -1, -1))
    hidden = torch.cat(tokens, dim=1)
    before = hidden.shape[1] - x.shape[1]
    places = torch.cat([steps[:, None].expand(-1, before), each], dim=1)
    times = [head.dit.time(places[:, i]) for i in range(hidden.shape[1])]
    masks = head._masks(context)
    for layer, block in enumerate(head.dit.blocks):
        modulation = torch.stack([block.modulation(time) for time in times], dim=1)
        scale, shift = modulation.chunk(2, dim=-1)
        normal = torch.nn.functional.layer_norm(hidden, hidden.shape[-1:]) * (1 + scale) + shift
        other, mask = (normal, None) if layer % 2 else (context.features, masks[layer // 2])
        hidden = hidden + block.attention(normal, other, mask)
        plain = torch.nn.functional.layer_norm(hidden, hidden.shape[-1:])
        hidden = hidden + block.feed_forward(plain)
    silu = torch.nn.functional.silu
    last = torch.stack([head.dit.modulate(silu(time)) for time in times], dim=1)
    shift, scale = last.chunk(2, dim=-1)
    normal = torch.nn.functional.layer_norm(hidden, hidden.shape[-1:], eps=1e-6)
    out = head.dit.out(normal * (1 + scale) + shift)
    return head.action_decoder(out[:, -x.shape[1] :], ids)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_chunk_continues_by_its_prefix(version):
    model, inputs = tiny(version, prefix_conditioning=True), to_act(batch(version))
    old = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 6, 5))).float()
    more = {
        "prev_actions": old,
        "prefix_weights": torch.ones(2, 6),
        "prefix_len": torch.tensor([2, 0]),
        "max_guidance_weight": torch.full((2,), 5.0),
    }
    with torch.no_grad():
        found = model.predict_action(**inputs, **more)
        free = model.predict_action(**inputs)
        later = {**more, "prev_actions": old.clone()}
        later["prev_actions"][0, 2:] = 9.0
        assert torch.equal(model.predict_action(**inputs, **later), found)
    assert torch.equal(found[0, :2], old[0, :2])
    torch.testing.assert_close(found[1], free[1], rtol=1e-5, atol=1e-5)
    assert not torch.allclose(found[0, 2:], free[0, 2:])


def test_prefixes_and_the_model_belong_together():
    inputs, length = batch("n1.5"), torch.zeros(2, 1, dtype=torch.int64)
    with pytest.raises(ConfigError, match="prefix_conditioning is True, and the batch has no"):
        tiny("n1.5", prefix_conditioning=True)(**inputs)
    with pytest.raises(ConfigError, match="prefix_conditioning is False, and the batch has a"):
        tiny("n1.5")(**inputs, prefix_len=length)


@pytest.mark.parametrize("version", VERSIONS)
def test_units_to_shard_are_disjoint_and_hold_most_weights(version):
    model = published(version)
    seen = [id(p) for unit in model.fsdp_units() for p in unit.parameters()]
    assert len(seen) == len(set(seen))
    held = sum(p.numel() for unit in model.fsdp_units() for p in unit.parameters())
    assert held > 0.6 * sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ori_action_dim": 6}, r"ori_action_dim must be in 1\.\.5, got 6"),
        ({"horizon": 11}, r"horizon must be in 1\.\.10, got 11"),
        ({"layers": 3}, "layers 3 is odd"),
        ({"context_heads": 3}, "context_dim 16 is not a multiple of context_heads 3"),
        ({"attend_text_every": 1}, "attend_text_every must be at least 2, got 1"),
    ],
)
def test_sizes_of_the_head_that_do_not_fit_are_refused(change, words):
    settings = {**TINY_HEAD, "layers": 2, "context_dim": 16, **change}
    settings.pop("type")
    with pytest.raises(ConfigError, match=words):
        GR00TActionHead(**settings)


@pytest.mark.parametrize(
    ("kind", "settings", "words"),
    [
        (EagleBackbone, {"image_size": 30, "patch_size": 14}, "30 is not a multiple of patch_size"),
        (EagleBackbone, {"vocabulary": 100}, "image_token 151669 is not one of the 100 tokens"),
        (Qwen3VLBackbone, {"deepstack": [30]}, r"deepstack \[30\] names layers that 24 vision"),
        (Qwen3VLBackbone, {"text_head_dim": 64}, "add up to 64, half of text_head_dim 64"),
    ],
)
def test_sizes_of_a_backbone_that_do_not_fit_are_refused(kind, settings, words):
    with pytest.raises(ConfigError, match=words), torch.device("meta"):
        kind(**settings)


@pytest.mark.parametrize(
    ("version", "change", "words"),
    [
        ("n1.5", {"images": torch.zeros(2, 6, 30, 28)}, r"\(2, 6, 30, 28\), \(B, 3N, 28, 28\)"),
        ("n1.7", {"images": torch.zeros(2, 6, 20, 16)}, "multiples of 8 expected"),
        (
            "n1.5",
            {"images": torch.zeros(2, 3, 28, 28)},
            r"\[8\] image tokens .* 1 images take 1",
        ),
        (
            "n1.7",
            {"images": torch.zeros(2, 3, 16, 16)},
            r"\[8\] image tokens .* 1 images take 1",
        ),
        ("n1.7", {"embodiment_ids": torch.tensor([0, 3])}, r"\[0, 3\] are not all in 0\.\.2"),
    ],
)
def test_batches_that_do_not_fit_are_refused(version, change, words):
    with pytest.raises(ConfigError, match=words):
        tiny(version).predict_action(**{**to_act(batch(version)), **change})


def test_an_embodiment_without_layers_is_refused():
    with pytest.raises(ConfigError, match=r"embodiment_id 3 is not in 0\.\.2"):
        GR00T(TINY_N17["vlm_backbone"], TINY_N17["vla_head"], embodiment_id=3)


def test_the_old_name_of_image_token_still_works():
    with pytest.warns(DeprecationWarning, match="picture_token is deprecated, use image_token"):
        token = image_token_of("EagleBackbone", 7, 9, 10)
    assert token == 9
    assert image_token_of("EagleBackbone", 7, None, 10) == 7


@pytest.mark.parametrize(
    ("version", "config"),
    [("n1.5", "gr00t_n15_aloha_lora.py"), ("n1.7", "gr00t_n17_libero_lora.py")],
)
def test_the_models_own_lora_layers_are_those_of_the_config(version, config):
    pytest.importorskip("peft")
    assert adapted(tiny(version), OWN) == adapted(tiny(version), shipped(config))
