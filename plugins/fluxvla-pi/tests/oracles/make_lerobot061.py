"""PI0 and PI0.5 of LeRobot with tiny weights: losses, gradients, sampled actions.

    HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 PYTHONPATH=. python \\
        plugins/fluxvla-pi/tests/oracles/make_lerobot061.py [FOLDER]

LeRobot writes the sizes of its networks into its code. Three patches of its two modeling modules
make them small: the table of Gemma sizes, and the two networks, whose settings are changed before
they are built. What they compute is LeRobot's.
"""

from __future__ import annotations

import sys
from pathlib import Path

import lerobot
import pi_inputs as tiny
import torch
import transformers
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from safetensors.torch import save_file

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
VERSIONS = {
    "lerobot": lerobot.__version__,
    "transformers": transformers.__version__,
    "torch": torch.__version__.partition("+")[0],
}
FAMILIES = {
    "pi0": (modeling_pi0, PI0Config, modeling_pi0.PI0Policy),
    "pi05": (modeling_pi05, PI05Config, modeling_pi05.PI05Policy),
}
# Of every kind of weight one, and of both ends of both towers.
GRADIENTS = (
    "paligemma_with_expert.paligemma.model.vision_tower.vision_model.embeddings.patch_embedding.bias",
    "paligemma_with_expert.paligemma.model.vision_tower.vision_model.embeddings.position_embedding.weight",
    "paligemma_with_expert.paligemma.model.vision_tower.vision_model.encoder.layers.1.mlp.fc1.weight",
    "paligemma_with_expert.paligemma.model.multi_modal_projector.linear.weight",
    "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight",
    "paligemma_with_expert.paligemma.model.language_model.layers.0.self_attn.q_proj.weight",
    "paligemma_with_expert.paligemma.model.language_model.layers.1.mlp.up_proj.weight",
    "paligemma_with_expert.paligemma.model.language_model.layers.2.self_attn.k_proj.weight",
    "paligemma_with_expert.paligemma.model.language_model.layers.2.input_layernorm.weight",
    "paligemma_with_expert.gemma_expert.model.layers.0.self_attn.q_proj.weight",
    "paligemma_with_expert.gemma_expert.model.layers.1.self_attn.v_proj.weight",
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
        "paligemma_with_expert.gemma_expert.model.layers.2.post_attention_layernorm.dense.bias",
        "paligemma_with_expert.gemma_expert.model.norm.dense.weight",
        "time_mlp_in.weight",
        "time_mlp_out.weight",
    ),
}


def shrink(module, projection=tiny.GEMMA["width"]) -> None:
    """Make the networks of a modeling module small."""
    if hasattr(module, "made_small"):
        return
    paligemma, gemma = (
        module.PaliGemmaForConditionalGenerationWithPiGemma,
        module.PiGemmaForCausalLM,
    )

    def small_paligemma(config):
        vision = config.vision_config
        vision.hidden_size = tiny.VISION["width"]
        vision.intermediate_size = tiny.VISION["mlp_dim"]
        vision.num_hidden_layers = tiny.VISION["depth"]
        vision.num_attention_heads = tiny.VISION["heads"]
        vision.patch_size = tiny.VISION["patch_size"]
        vision.projection_dim = projection
        config.projection_dim = projection
        config.text_config.vocab_size = tiny.VOCABULARY
        config.text_config.pad_token_id = 0
        return paligemma(config=config)

    def small_gemma(config):
        config.vocab_size = tiny.VOCABULARY
        config.pad_token_id = 0
        return gemma(config=config)

    def small_size(variant):
        size = {"gemma_2b": tiny.GEMMA, "gemma_300m": tiny.EXPERT}[variant]
        names = {"heads": "num_heads", "kv_heads": "num_kv_heads"}
        return module.GemmaConfig(**{names.get(key, key): n for key, n in size.items()})

    module.get_gemma_config = small_size
    module.PaliGemmaForConditionalGenerationWithPiGemma = small_paligemma
    module.PiGemmaForCausalLM = small_gemma
    module.made_small = True


def policy_of(family: str, **settings):
    """A tiny policy of LeRobot with every tensor filled by its name."""
    module, config_of, policy_kind = FAMILIES[family]
    shrink(module)
    side = tiny.VISION["image_size"]
    cameras = {
        f"observation.images.camera{i}": PolicyFeature(FeatureType.VISUAL, (3, side, side))
        for i in range(tiny.CAMERAS)
    }
    config = config_of(
        **{
            "input_features": {
                **cameras,
                "observation.state": PolicyFeature(FeatureType.STATE, (tiny.STATES,)),
            },
            "output_features": {"action": PolicyFeature(FeatureType.ACTION, (tiny.ACTIONS,))},
            "image_resolution": (side, side),
            "chunk_size": tiny.HORIZON,
            "n_action_steps": tiny.HORIZON,
            "max_state_dim": tiny.STATES,
            "max_action_dim": tiny.ACTIONS,
            "dtype": "float32",
            "device": "cpu",
            **settings,
        }
    )
    policy = policy_kind(config).eval()
    state = {
        name: torch.from_numpy(fill.weight(name, tuple(tensor.shape)))
        for name, tensor in policy.state_dict().items()
    }
    policy.load_state_dict(state)
    return policy


def numbers(family: str) -> dict[str, torch.Tensor]:
    """Losses, gradients and actions of a family."""
    model = policy_of(family).model
    batch = {key: torch.from_numpy(value) for key, value in tiny.inputs().items()}
    side = tiny.VISION["image_size"]
    pictures = batch["images"].reshape(tiny.BATCH, tiny.CAMERAS, 3, side, side).unbind(1)
    seen = (
        list(pictures),
        list(batch["img_masks"].unbind(1)),
        batch["lang_tokens"],
        batch["lang_masks"],
    )
    state = (batch["states"],) if family == "pi0" else ()
    losses = model.forward(*seen, *state, batch["actions"], batch["noise"], batch["tau"])
    losses.mean().backward()
    gradients = {name: p.grad for name, p in model.named_parameters()}
    found = {f"gradient.{name}": gradients[name] for name in (*GRADIENTS, *ONLY[family])}
    unused = [name for name, gradient in gradients.items() if gradient is None]
    used = [name for name in gradients if name not in unused]
    assert any(name.endswith("lm_head.weight") for name in unused), used
    found["losses"] = losses.detach()
    found["actions"] = model.sample_actions(*seen, *state, noise=batch["noise"])
    return found


def main() -> None:
    torch.set_num_threads(1)
    default = Path(__file__).parents[1] / "golden"
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    folder.mkdir(parents=True, exist_ok=True)
    for family in FAMILIES:
        found = {name: tensor.contiguous() for name, tensor in numbers(family).items()}
        save_file(found, folder / f"lerobot061_{family}.safetensors", VERSIONS)


if __name__ == "__main__":
    main()
