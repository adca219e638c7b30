"""PI0 and PI0.5 of openpi's PyTorch port with tiny weights: losses, gradients, sampled actions.

By hand: a checkout of github.com/Physical-Intelligence/openpi (15a9616), and an environment with
torch 2.13.0 and ``transformers==4.53.2``, with the files of the checkout's
``src/openpi/models_pytorch/transformers_replace`` copied over the latter (openpi's README).
From the repository's root:

    OMP_NUM_THREADS=1 PYTHONPATH=.:CHECKOUT/src ENVIRONMENT/bin/python \\
        plugins/fluxvla-pi/tests/oracles/make_openpi.py [FOLDER]

What is not openpi's here: the sizes of the networks, which its code has written into it; and the
two modules that it imports JAX for, of which one says those sizes, and the other resizes images,
which these tests do not need (``test_openpi_format.py`` is about those).
"""

from __future__ import annotations

import sys
import types
from pathlib import Path

import pi_inputs as tiny
import torch
import transformers
from safetensors.torch import save_file

from tests.oracles import fill

COMMIT = "15a9616a00943ada6c20a0f158e3adb39df2ccac"
VERSIONS = {
    "openpi": COMMIT,
    "transformers": transformers.__version__,
    "torch": torch.__version__.partition("+")[0],
}
# Of every kind of weight one, and of both ends of both towers.
GRADIENTS = (
    "paligemma_with_expert.paligemma.model.vision_tower.vision_model.embeddings.patch_embedding.bias",
    "paligemma_with_expert.paligemma.model.vision_tower.vision_model.encoder.layers.1.mlp.fc1.weight",
    "paligemma_with_expert.paligemma.model.multi_modal_projector.linear.weight",
    "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight",
    "paligemma_with_expert.paligemma.model.language_model.layers.0.self_attn.q_proj.weight",
    "paligemma_with_expert.paligemma.model.language_model.layers.2.input_layernorm.weight",
    "paligemma_with_expert.gemma_expert.model.layers.0.self_attn.q_proj.weight",
    "paligemma_with_expert.gemma_expert.model.layers.2.mlp.down_proj.weight",
    "action_in_proj.weight",
    "action_out_proj.bias",
)
ONLY = {
    "pi0": (
        "paligemma_with_expert.gemma_expert.model.layers.2.post_attention_layernorm.weight",
        "state_proj.weight",
        "action_time_mlp_in.weight",
    ),
    "pi05": (
        "paligemma_with_expert.gemma_expert.model.layers.0.input_layernorm.dense.weight",
        "paligemma_with_expert.gemma_expert.model.norm.dense.weight",
        "time_mlp_in.weight",
    ),
}


# openpi adds its step up in float32: of 8 steps each time is exact, of 10 the last are not, and the
# quickest wave of the time's embedding makes 1e-4 rad of that.
STEPS = (8, 10)


def size_of(variant: str) -> types.SimpleNamespace:
    """The sizes that openpi would have in a table."""
    size = {"gemma_2b": tiny.GEMMA, "gemma_300m": tiny.EXPERT}[variant]
    names = {"heads": "num_heads", "kv_heads": "num_kv_heads"}
    return types.SimpleNamespace(**{names.get(key, key): number for key, number in size.items()})


def without_jax():
    """openpi's ``PI0Pytorch`` and the module of its networks."""
    sizes = types.ModuleType("openpi.models.gemma")
    sizes.get_config = size_of
    sys.modules |= {
        "openpi.models.gemma": sizes,
        "openpi.shared.image_tools": types.ModuleType("openpi.shared.image_tools"),
    }
    import openpi.models
    import openpi.shared

    openpi.models.gemma = sizes
    openpi.shared.image_tools = sys.modules["openpi.shared.image_tools"]
    from openpi.models_pytorch import gemma_pytorch, pi0_pytorch

    return pi0_pytorch.PI0Pytorch, gemma_pytorch


def shrink(module) -> None:
    """Make the networks small, before they are built."""
    paligemma, gemma = module.PaliGemmaForConditionalGeneration, module.GemmaForCausalLM

    def small_paligemma(config):
        vision = config.vision_config
        vision.hidden_size = tiny.VISION["width"]
        vision.intermediate_size = tiny.VISION["mlp_dim"]
        vision.num_hidden_layers = tiny.VISION["depth"]
        vision.num_attention_heads = tiny.VISION["heads"]
        vision.patch_size = tiny.VISION["patch_size"]
        vision.image_size = tiny.VISION["image_size"]
        vision.projection_dim = config.projection_dim = tiny.GEMMA["width"]
        config.text_config.vocab_size = tiny.VOCABULARY
        config.text_config.pad_token_id = config.pad_token_id = 0
        return paligemma(config=config)

    def small_gemma(config):
        config.vocab_size = tiny.VOCABULARY
        config.pad_token_id = 0
        return gemma(config=config)

    module.PaliGemmaForConditionalGeneration = small_paligemma
    module.GemmaForCausalLM = small_gemma


def model_of(kind, family: str):
    """A tiny model with every tensor filled by its name."""
    config = types.SimpleNamespace(
        pi05=family == "pi05",
        paligemma_variant="gemma_2b",
        action_expert_variant="gemma_300m",
        dtype="float32",
        action_dim=tiny.ACTIONS,
        action_horizon=tiny.HORIZON,
        pytorch_compile_mode=None,
    )
    model = kind(config).eval()
    state = {
        name: torch.from_numpy(fill.weight(name, tuple(tensor.shape)))
        for name, tensor in model.state_dict().items()
    }
    # One tensor under two names; ours has the name of the embedding.
    language = "paligemma_with_expert.paligemma."
    embedding = state[f"{language}model.language_model.embed_tokens.weight"]
    model.load_state_dict({**state, f"{language}lm_head.weight": embedding})
    return model


def numbers(model, family: str) -> dict[str, torch.Tensor]:
    """Losses, gradients and actions."""
    batch = {key: torch.from_numpy(value) for key, value in tiny.inputs().items()}
    side = tiny.VISION["image_size"]
    pictures = batch["images"].reshape(tiny.BATCH, tiny.CAMERAS, 3, side, side).unbind(1)
    observed = (
        list(pictures),
        list(batch["img_masks"].unbind(1)),
        batch["lang_tokens"],
        batch["lang_masks"],
        batch["states"],
    )
    # The images are as large as the network wants them, and are not to be augmented.
    model._preprocess_observation = lambda observation, train: observation
    losses = model.forward(observed, batch["actions"], batch["noise"], batch["tau"])
    losses.mean().backward()
    gradients = {name: p.grad for name, p in model.named_parameters()}
    found = {f"gradient.{name}": gradients[name] for name in (*GRADIENTS, *ONLY[family])}

    class Observed(tuple):
        state = batch["states"]

    found["losses"] = losses.detach()
    device = torch.device("cpu")
    for steps in STEPS:
        found[f"actions.{steps}"] = model.sample_actions(
            device, Observed(observed), noise=batch["noise"], num_steps=steps
        )
    return found


def main() -> None:
    torch.set_num_threads(1)
    default = Path(__file__).parents[1] / "golden"
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    folder.mkdir(parents=True, exist_ok=True)
    kind, networks = without_jax()
    shrink(networks)
    for family in ("pi0", "pi05"):
        found = numbers(model_of(kind, family), family)
        tensors = {name: tensor.contiguous() for name, tensor in found.items()}
        save_file(tensors, folder / f"openpi_{family}.safetensors", VERSIONS)


if __name__ == "__main__":
    main()
