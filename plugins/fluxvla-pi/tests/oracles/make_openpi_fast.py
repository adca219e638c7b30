"""PI0-FAST of openpi's own JAX code with tiny weights: losses, gradients, greedy answers.

By hand: a checkout of github.com/Physical-Intelligence/openpi (15a9616), and an environment with
what its modules import, of which these versions matter: ``jax==0.5.3 flax==0.10.2 numpy<2
ml_collections==1.0.0 orbax-checkpoint==0.11.13 jaxtyping==0.2.36 beartype==0.19.0 augmax einops
safetensors torch transformers==4.53.2``. From the repository's root:

    OMP_NUM_THREADS=1 PYTHONPATH=.:CHECKOUT/src ENVIRONMENT/bin/python \\
        plugins/fluxvla-pi/tests/oracles/make_openpi_fast.py [FOLDER]

What is not openpi's here: the sizes, which its code has written into it. Weights have the names and
shapes of LeRobot's files, and are brought into the layout of JAX's; gradients go the way back. The
answer begins with ``<bos>``, as LeRobot has it: openpi's model takes any tokens, and which of them
are causal and which count. All cameras are there: without one, openpi's positions differ between
training and acting.

``answers.training`` are greedy by the function that training uses. ``answers.sampled`` are those of
``sample_actions``, which gives the token behind the prompt the position after the next: 1 beyond
where it is in training.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import flax
import jax
import jax.numpy as jnp
import ml_collections
import numpy as np
import pi_inputs as tiny
from flax import nnx
from flax.traverse_util import flatten_dict, unflatten_dict
from openpi.models import gemma_fast, model, pi0_fast, siglip
from safetensors.numpy import save_file

from tests.oracles import fill

COMMIT = "15a9616a00943ada6c20a0f158e3adb39df2ccac"
VERSIONS = {"openpi": COMMIT, "jax": jax.__version__, "flax": flax.__version__}
SIDE = tiny.VISION["image_size"]
_P = "model.paligemma_with_expert.paligemma."
_TOWER = f"{_P}model.vision_tower.vision_model."
_WORDS = f"{_P}model.language_model."
GRADIENTS = (
    f"{_TOWER}embeddings.patch_embedding.weight",
    f"{_TOWER}embeddings.position_embedding.weight",
    f"{_TOWER}encoder.layers.0.self_attn.q_proj.weight",
    f"{_TOWER}encoder.layers.1.self_attn.out_proj.weight",
    f"{_TOWER}encoder.layers.1.mlp.fc1.weight",
    f"{_P}model.multi_modal_projector.linear.weight",
    f"{_WORDS}embed_tokens.weight",
    f"{_WORDS}layers.0.self_attn.q_proj.weight",
    f"{_WORDS}layers.1.mlp.up_proj.weight",
    f"{_WORDS}layers.2.self_attn.k_proj.weight",
    f"{_WORDS}layers.2.self_attn.o_proj.weight",
    f"{_WORDS}layers.2.mlp.down_proj.weight",
    f"{_WORDS}layers.2.post_attention_layernorm.weight",
    f"{_WORDS}norm.weight",
)
Array = np.ndarray


@dataclass(frozen=True)
class Kind:
    """How an array of JAX's is laid out as a tensor of the published files, and back.

    Args:
        there: array -> tensor.
        back: tensor and the array's shape -> array.
    """

    there: Callable[[Array], Array]
    back: Callable[[Array, tuple[int, ...]], Array]


SAME = Kind(lambda a: a, lambda t, shape: t)
FLAT = Kind(lambda a: a.reshape(-1), lambda t, shape: t.reshape(shape))
LINEAR = Kind(lambda a: a.T, lambda t, shape: t.T)
FROM_HEADS = Kind(lambda a: a.reshape(-1, a.shape[-1]).T, lambda t, shape: t.T.reshape(shape))
TO_HEADS = Kind(lambda a: a.reshape(len(a), -1).T, lambda t, shape: t.T.reshape(shape))
HEADS_FIRST = Kind(
    lambda a: a.transpose(0, 2, 1).reshape(-1, a.shape[1]),
    lambda t, shape: t.reshape(shape[0], shape[2], shape[1]).transpose(0, 2, 1),
)
CONVOLUTION = Kind(lambda a: a.transpose(3, 2, 0, 1), lambda t, shape: t.transpose(2, 3, 1, 0))
FIRST = Kind(lambda a: a[0], lambda t, shape: t[None])

# JAX's name -> published name and layout.
SINGLE = {
    "img/embedding/kernel": (f"{_TOWER}embeddings.patch_embedding.weight", CONVOLUTION),
    "img/embedding/bias": (f"{_TOWER}embeddings.patch_embedding.bias", SAME),
    "img/pos_embedding": (f"{_TOWER}embeddings.position_embedding.weight", FIRST),
    "img/Transformer/encoder_norm/scale": (f"{_TOWER}post_layernorm.weight", SAME),
    "img/Transformer/encoder_norm/bias": (f"{_TOWER}post_layernorm.bias", SAME),
    "img/head/kernel": (f"{_P}model.multi_modal_projector.linear.weight", LINEAR),
    "img/head/bias": (f"{_P}model.multi_modal_projector.linear.bias", SAME),
    "llm/embedder/input_embedding": (f"{_WORDS}embed_tokens.weight", SAME),
    "llm/final_norm/scale": (f"{_WORDS}norm.weight", SAME),
}
_ATTENTION = "img/Transformer/encoderblock/MultiHeadDotProductAttention_0"
# All layers of a kind are one array: beneath a layer, which part of it, and what it is.
LAYERS: dict[str, list[tuple[tuple[int, ...], str, Kind]]] = {
    **{
        f"img/Transformer/encoderblock/LayerNorm_{i}/{name}": [
            ((), f"{_TOWER}encoder.layers.{{}}.layer_norm{i + 1}.{theirs}", SAME)
        ]
        for i in (0, 1)
        for name, theirs in (("scale", "weight"), ("bias", "bias"))
    },
    **{
        f"img/Transformer/encoderblock/MlpBlock_0/Dense_{i}/{name}": [
            ((), f"{_TOWER}encoder.layers.{{}}.mlp.fc{i + 1}.{theirs}", kind)
        ]
        for i in (0, 1)
        for name, theirs, kind in (("kernel", "weight", LINEAR), ("bias", "bias", SAME))
    },
    **{
        f"{_ATTENTION}/{name}/{part}": [
            ((), f"{_TOWER}encoder.layers.{{}}.self_attn.{theirs}.{end}", kind)
        ]
        for name, theirs in (
            ("query", "q_proj"),
            ("key", "k_proj"),
            ("value", "v_proj"),
            ("out", "out_proj"),
        )
        for part, end, kind in (
            ("kernel", "weight", FROM_HEADS if name == "out" else TO_HEADS),
            ("bias", "bias", SAME if name == "out" else FLAT),
        )
    },
    "llm/layers/attn/q_einsum/w": [
        ((), f"{_WORDS}layers.{{}}.self_attn.q_proj.weight", HEADS_FIRST)
    ],
    "llm/layers/attn/kv_einsum/w": [
        ((i,), f"{_WORDS}layers.{{}}.self_attn.{name}_proj.weight", HEADS_FIRST)
        for i, name in enumerate("kv")
    ],
    "llm/layers/attn/attn_vec_einsum/w": [
        ((), f"{_WORDS}layers.{{}}.self_attn.o_proj.weight", FROM_HEADS)
    ],
    "llm/layers/mlp/gating_einsum": [
        ((i,), f"{_WORDS}layers.{{}}.mlp.{name}_proj.weight", LINEAR)
        for i, name in enumerate(("gate", "up"))
    ],
    "llm/layers/mlp/linear": [((), f"{_WORDS}layers.{{}}.mlp.down_proj.weight", LINEAR)],
    "llm/layers/pre_attention_norm/scale": [
        ((), f"{_WORDS}layers.{{}}.input_layernorm.weight", SAME)
    ],
    "llm/layers/pre_ffw_norm/scale": [
        ((), f"{_WORDS}layers.{{}}.post_attention_layernorm.weight", SAME)
    ],
}


def parts(name: str, array: Array) -> Iterator[tuple[tuple[int, ...], str, Kind]]:
    """Of an array: the places of its parts, their published names and their layouts."""
    if name in SINGLE:
        yield (), *SINGLE[name]
        return
    for layer in range(len(array)):
        for place, published, kind in LAYERS[name]:
            yield (layer, *place), published.format(layer), kind


def filled(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Arrays of the same shapes, every tensor in them by its published name."""
    found = {}
    for name, array in arrays.items():
        made = np.full(array.shape, np.nan, np.float32)
        for place, published, kind in parts(name, array):
            shape = array[place].shape
            tensor = fill.weight(published, kind.there(np.empty(shape, np.float32)).shape)
            made[place] = kind.back(tensor, shape)
        assert np.isfinite(made).all(), name
        found[name] = made
    assert found.keys() == SINGLE.keys() | LAYERS.keys()
    return found


def published(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Every tensor by its published name."""
    return {
        title: kind.there(array[place])
        for name, array in arrays.items()
        for place, title, kind in parts(name, array)
    }


def arrays_of(state: nnx.State) -> dict[str, Array]:
    """The weights, by JAX's names."""
    flat = flatten_dict(state.to_pure_dict()["PaliGemma"], sep="/")
    return {name: np.asarray(array) for name, array in flat.items()}


def shrink() -> None:
    """Make openpi's networks small, before they are built."""
    names = {"heads": "num_heads", "kv_heads": "num_kv_heads"}
    size = {
        "variant": "gemma_2b",
        **{names.get(key, key): number for key, number in tiny.GEMMA.items()},
        "norm_eps": 1e-6,
        "vocab_size": tiny.FAST_WORDS,
        "scan": True,
        "remat_policy": "nothing_saveable",
    }
    gemma_fast.get_config = lambda variant: ml_collections.ConfigDict(size)
    patch = tiny.VISION["patch_size"]
    siglip.decode_variant = lambda variant: {
        "width": tiny.VISION["width"],
        "depth": tiny.VISION["depth"],
        "mlp_dim": tiny.VISION["mlp_dim"],
        "num_heads": tiny.VISION["heads"],
        "patch_size": (patch, patch),
    }
    model.IMAGE_RESOLUTION = (SIDE, SIDE)
    model.preprocess_observation = functools.partial(
        model.preprocess_observation, image_resolution=(SIDE, SIDE)
    )


def built() -> pi0_fast.Pi0FAST:
    """A tiny model with every tensor filled by its name."""
    config = pi0_fast.Pi0FASTConfig(
        dtype="float32",
        action_dim=tiny.ROBOT_ACTIONS,
        action_horizon=tiny.HORIZON,
        max_token_len=tiny.WORDS + tiny.FAST_TOKENS,
    )
    made = config.create(jax.random.key(0))
    state = nnx.state(made, nnx.Param)
    flat = filled(arrays_of(state))
    tree = unflatten_dict({tuple(name.split("/")): jnp.asarray(a) for name, a in flat.items()})
    state.replace_by_pure_dict({"PaliGemma": tree})
    nnx.update(made, state)
    return made


def observed(answers: Array, real: Array) -> model.Observation:
    """Prompts with ``answers`` ``(B, M)`` close behind, of which tokens are ``real``."""
    batch = tiny.fast_inputs()
    length = tiny.WORDS + answers.shape[1]
    tokens, mask, causal, counted = np.zeros((4, tiny.BATCH, length), np.int32)
    for row in range(tiny.BATCH):
        prompt = batch["lang_tokens"][row][batch["lang_masks"][row]]
        answer = answers[row][real[row]]
        end = len(prompt) + len(answer)
        tokens[row, :end] = [*prompt, *answer]
        mask[row, :end] = 1
        causal[row, len(prompt) :] = 1
        counted[row, len(prompt) + 1 : end] = 1
    images = batch["images"].reshape(tiny.BATCH, tiny.CAMERAS, 3, SIDE, SIDE)
    names = [f"camera_{i}_rgb" for i in range(tiny.CAMERAS)]
    there = jnp.ones(tiny.BATCH, bool)
    return model.Observation(
        images={n: jnp.asarray(images[:, i].transpose(0, 2, 3, 1)) for i, n in enumerate(names)},
        image_masks=dict.fromkeys(names, there),
        state=jnp.zeros((tiny.BATCH, tiny.ROBOT_ACTIONS)),
        tokenized_prompt=jnp.asarray(tokens),
        tokenized_prompt_mask=jnp.asarray(mask.astype(bool)),
        token_ar_mask=jnp.asarray(causal),
        token_loss_mask=jnp.asarray(counted.astype(bool)),
    )


def losses_of(made: pi0_fast.Pi0FAST, seen: model.Observation) -> jax.Array:
    actions = jnp.zeros((tiny.BATCH, tiny.HORIZON, tiny.ROBOT_ACTIONS))
    return made.compute_loss(jax.random.key(0), seen, actions)


def greedy(made: pi0_fast.Pi0FAST) -> Array:
    """Greedy answers ``(B, FAST_STEPS)``, each token by a whole pass as in training."""
    said = np.full((tiny.BATCH, 1), tiny.ACTION_WORDS["bos"])
    for _ in range(tiny.FAST_STEPS):
        seen = observed(said, np.ones(said.shape, bool))
        embedded, real, causal = made.embed_inputs(seen)
        hidden, _, _ = made.PaliGemma.llm(
            embedded_prefix=embedded,
            mask=pi0_fast.make_attn_mask(real, causal),
            return_prelogits=True,
        )
        logits, _ = made.PaliGemma.llm(pre_logits=hidden)
        last = np.asarray(real).sum(1) - 1
        said = np.concatenate(
            [said, np.asarray(logits)[range(tiny.BATCH), last].argmax(-1)[:, None]], 1
        )
    return said[:, 1:]


def main() -> None:
    default = Path(__file__).parents[1] / "golden"
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    folder.mkdir(parents=True, exist_ok=True)
    shrink()
    made = built()
    batch = tiny.fast_inputs()
    seen = observed(batch["action_tokens"], batch["action_token_masks"])
    found = {"losses": np.asarray(losses_of(made, seen))}
    gradients = nnx.grad(lambda one: losses_of(one, seen).mean())(made)
    named = published(arrays_of(gradients))
    found |= {f"gradient.{name}": named[name] for name in GRADIENTS}
    found["answers.training"] = greedy(made).astype(np.int64)
    first = np.full((tiny.BATCH, 1), tiny.ACTION_WORDS["bos"])
    asked = observed(first, np.ones(first.shape, bool))
    sampled = made.sample_actions(
        jax.random.key(0), asked, max_decoding_steps=tiny.FAST_STEPS, temperature=0.0
    )
    found["answers.sampled"] = np.asarray(sampled).astype(np.int64)
    arrays = {name: np.ascontiguousarray(array) for name, array in found.items()}
    save_file(arrays, folder / "openpi_pi0_fast.safetensors", VERSIONS)


if __name__ == "__main__":
    main()
