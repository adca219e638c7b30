"""PI0-FAST of LeRobot with tiny weights: losses, gradients, answers, actions; a whole policy.

    HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 PYTHONPATH=. python \\
        plugins/fluxvla-pi/tests/oracles/make_lerobot061_fast.py [FOLDER]

Its networks are made small as those of PI0 are (``make_lerobot061.py``). LeRobot names two
tokenizers of the hub. It gets one of single letters instead, and a FAST tokenizer that is fitted
here as its authors describe, and stored; a class with what LeRobot uses of the published processor
stands for that. Names and shapes of the full-size model go to ``keys``.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import pi_inputs as tiny
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.processor import tokenizer_processor
from make_lerobot061 import VERSIONS
from safetensors.torch import save_file
from scipy.fft import dct
from tokenizers import ByteLevelBPETokenizer
from tokenizers.trainers import BpeTrainer
from transformers import PreTrainedTokenizerFast

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
SCALE = 10
_P = "paligemma_with_expert.paligemma."
GRADIENTS = (
    f"{_P}model.vision_tower.vision_model.embeddings.patch_embedding.bias",
    f"{_P}model.vision_tower.vision_model.encoder.layers.1.mlp.fc1.weight",
    f"{_P}model.multi_modal_projector.linear.weight",
    f"{_P}model.language_model.embed_tokens.weight",
    f"{_P}model.language_model.layers.0.self_attn.q_proj.weight",
    f"{_P}model.language_model.layers.1.mlp.up_proj.weight",
    f"{_P}model.language_model.layers.2.self_attn.k_proj.weight",
    f"{_P}model.language_model.layers.2.self_attn.o_proj.weight",
    f"{_P}model.language_model.layers.2.mlp.down_proj.weight",
    f"{_P}model.language_model.layers.2.post_attention_layernorm.weight",
    f"{_P}model.language_model.norm.weight",
    f"{_P}lm_head.weight",
)


class Words:
    """Stands for transformers' ``AutoTokenizer``."""

    @staticmethod
    def from_pretrained(name: str, add_bos_token: bool = True, add_eos_token=False, **settings):
        template = " ".join([*["<bos>"] * add_bos_token, "$A", *["<eos>"] * add_eos_token])
        return PreTrainedTokenizerFast(
            tokenizer_object=tiny.fast_text_tokenizer(template),
            pad_token="<pad>",
            bos_token="<bos>",
            eos_token="<eos>",
        )


class Actions:
    """Stands for ``AutoProcessor``, and for the processor that it loads: the paper's equations."""

    folder: Path

    @classmethod
    def from_pretrained(cls, name: str, **settings):
        return cls()

    def __init__(self) -> None:
        settings = json.loads((self.folder / "processor_config.json").read_text())
        self.scale, self.min_token = settings["scale"], settings["min_token"]
        self.bpe_tokenizer = PreTrainedTokenizerFast.from_pretrained(self.folder)

    def __call__(self, chunks) -> list[list[int]]:
        rows = np.around(dct(np.asarray(chunks), axis=1, norm="ortho") * self.scale)
        texts = ["".join(map(chr, _codes(row, self.min_token))) for row in rows]
        return [self.bpe_tokenizer(text)["input_ids"] for text in texts]


def _codes(numbers, lowest):
    return np.maximum(numbers.flatten() - lowest, 0).astype(int)


def fit_actions(folder: Path) -> None:
    """Fit the FAST tokenizer to ``fast_chunks`` as the published one was fitted."""
    rows = [np.around(dct(c, axis=0, norm="ortho") * SCALE) for c in tiny.fast_chunks()]
    lowest, highest = (int(f([f(row) for row in rows])) for f in (np.min, np.max))
    made = ByteLevelBPETokenizer()
    trainer = BpeTrainer(
        vocab_size=tiny.FAST_VOCABULARY,
        min_frequency=2,
        show_progress=False,
        special_tokens=[],
        initial_alphabet=[chr(i) for i in range(highest - lowest + 1)],
        max_token_length=10000,
    )
    texts = ["".join(map(chr, _codes(row, lowest))) for row in rows]
    made._tokenizer.train_from_iterator(texts, trainer=trainer)
    folder.mkdir(parents=True, exist_ok=True)
    PreTrainedTokenizerFast(
        tokenizer_object=made._tokenizer, clean_up_tokenization_spaces=False
    ).save_pretrained(folder)
    settings = {"scale": SCALE, "vocab_size": tiny.FAST_VOCABULARY, "min_token": lowest}
    (folder / "processor_config.json").write_text(json.dumps(settings))


def shrink() -> None:
    """Make LeRobot's networks small."""
    module = modeling_pi0_fast
    whole = module.PaliGemmaForConditionalGenerationWithPiGemma

    def small(config):
        vision, width = config.vision_config, tiny.GEMMA["width"]
        vision.hidden_size = tiny.VISION["width"]
        vision.intermediate_size = tiny.VISION["mlp_dim"]
        vision.num_hidden_layers = tiny.VISION["depth"]
        vision.num_attention_heads = tiny.VISION["heads"]
        vision.patch_size = tiny.VISION["patch_size"]
        vision.image_size = tiny.VISION["image_size"]
        vision.projection_dim = config.projection_dim = width
        config.text_config.vocab_size = tiny.FAST_WORDS
        config.text_config.pad_token_id = 0
        return whole(config=config)

    names = {"heads": "num_heads", "kv_heads": "num_kv_heads"}
    size = module.GemmaConfig(**{names.get(key, key): n for key, n in tiny.GEMMA.items()})
    module.get_gemma_config = lambda variant: size
    module.PaliGemmaForConditionalGenerationWithPiGemma = small


def policy_of():
    """A tiny policy with every tensor filled by its name."""
    side = tiny.VISION["image_size"]
    cameras = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *size))
        for name, size in tiny.SIZES_OF_CAMERAS.items()
    }
    state = PolicyFeature(FeatureType.STATE, (tiny.ROBOT_STATES,))
    config = PI0FastConfig(
        input_features={**cameras, "observation.state": state},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (tiny.ROBOT_ACTIONS,))},
        image_resolution=(side, side),
        chunk_size=tiny.HORIZON,
        n_action_steps=tiny.HORIZON,
        max_action_tokens=64,
        max_decoding_steps=tiny.FAST_STEPS,
        validate_action_token_prefix=False,
        tokenizer_max_length=120,
        dtype="float32",
        device="cpu",
    )
    policy = modeling_pi0_fast.PI0FastPolicy(config).eval()
    state = {
        name: torch.from_numpy(fill.weight(name, tuple(tensor.shape)))
        for name, tensor in policy.state_dict().items()
    }
    policy.load_state_dict(state)
    return policy


def by_training_mask(model, seen, steps: int) -> torch.Tensor:
    """Greedy answers by the attention that LeRobot trains with, ``(B, steps)``.

    Its own sampling lets the prompt attend to the answer's first token.
    """
    tokens = torch.full((tiny.BATCH, 1), tiny.ACTION_WORDS["bos"])
    for _ in range(steps):
        embedded, real, mask, _, _ = model.embed_prefix_fast(
            *seen, fast_action_tokens=tokens, fast_action_masks=torch.ones_like(tokens).bool()
        )
        (out, _), _ = model.paligemma_with_expert.forward(
            attention_mask=modeling_pi0_fast.prepare_attention_masks_4d(mask, dtype=embedded.dtype),
            position_ids=real.cumsum(1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=False,
        )
        logits = model.paligemma_with_expert.paligemma.lm_head(out[:, -1:])
        tokens = torch.cat([tokens, logits[:, -1].argmax(-1, keepdim=True)], 1)
    return tokens[:, 1:]


def numbers() -> dict[str, torch.Tensor]:
    """Losses, gradients, answers, and what LeRobot makes of answers."""
    policy = policy_of()
    model = policy.model
    batch = {key: torch.from_numpy(value) for key, value in tiny.fast_inputs().items()}
    side = tiny.VISION["image_size"]
    pictures = batch["images"].reshape(tiny.BATCH, tiny.CAMERAS, 3, side, side).unbind(1)
    seen = (
        list(pictures),
        list(batch["img_masks"].unbind(1)),
        batch["lang_tokens"],
        batch["lang_masks"],
    )
    said = (batch["action_tokens"], batch["action_token_masks"])
    found = {"batch_loss": model.forward(*seen, *said)["loss"].detach()}
    losses = []
    for row in range(tiny.BATCH):
        one = [[part[row : row + 1] for part in parts] for parts in seen[:2]]
        two = [part[row : row + 1] for part in (*seen[2:], *said)]
        losses.append(model.forward(*one, *two)["loss"])
    torch.stack(losses).mean().backward()
    gradients = {name: p.grad for name, p in model.named_parameters()}
    found |= {f"gradient.{name}": gradients[name] for name in GRADIENTS}
    found["losses"] = torch.stack(losses).detach()
    with torch.no_grad():
        found["answers"] = model.sample_actions_fast_kv_cache(*seen, tiny.FAST_STEPS)
        again = model.sample_actions_fast(*seen, tiny.FAST_STEPS)
        assert torch.equal(found["answers"], again)
        found["answers.training_mask"] = by_training_mask(model, seen, tiny.FAST_STEPS)
    chunk = torch.from_numpy(fill.normal("chunk", (1, tiny.HORIZON, tiny.ROBOT_ACTIONS)))
    ids = policy.action_tokenizer(chunk)[0]
    found["ids"] = torch.tensor(ids)
    for name, answer in tiny.fast_answers(ids).items():
        actions = policy.detokenize_actions(
            torch.tensor([answer]), tiny.HORIZON, tiny.ROBOT_ACTIONS
        )
        found[f"actions.{name}"] = actions[0]
    return found


def whole_policy(folder: Path) -> dict[str, torch.Tensor]:
    """Save a policy in ``folder``, load it, and let it act."""
    stats = {
        key: {name: torch.from_numpy(row) for name, row in rows.items()}
        for key, rows in tiny.statistics().items()
    }
    policy = policy_of()
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)
    policy = modeling_pi0_fast.PI0FastPolicy.from_pretrained(folder).eval()
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    images, state = tiny.observation()
    seen = {
        f"observation.images.{name}": torch.from_numpy(image).permute(2, 0, 1) / 255.0
        for name, image in images.items()
    }
    task = tiny.TASKS["pi05"]
    raw = {**seen, "observation.state": torch.from_numpy(state), "task": task}
    batch = before({**raw, "action": torch.from_numpy(tiny.chunk())})
    found = {
        "normalized_actions": batch["action"],
        "tokens": batch["observation.language.tokens"],
        "token_masks": batch["observation.language.attention_mask"],
        "action_tokens": batch["action.tokens"],
        "action_token_masks": batch["action.token_mask"],
    }
    batch = before(raw)
    words = (batch["observation.language.tokens"], batch["observation.language.attention_mask"])
    pictures = policy._preprocess_images(batch)
    found["answer"] = policy.model.sample_actions_fast_kv_cache(*pictures, *words, tiny.FAST_STEPS)
    found["commands"] = after(policy.predict_action_chunk(batch))
    whole = tiny.fast_answers(policy.action_tokenizer(found["normalized_actions"])[0])["whole"]
    chunk = policy.detokenize_actions(torch.tensor([whole]), tiny.HORIZON, tiny.ROBOT_ACTIONS)
    found["decoded_commands"] = after(chunk)
    return found


def full_size(file: Path) -> None:
    """Names and shapes of the full-size model's tensors, layers written once."""
    with torch.device("meta"):
        model = modeling_pi0_fast.PI0FastPaliGemma(
            modeling_pi0_fast.get_gemma_config("gemma_2b"), precision="float32"
        )
    tensors: dict[str, list[int]] = {}
    for name, tensor in model.state_dict().items():
        before, layers, after = name.partition(".layers.")
        number, _, rest = after.partition(".")
        count = 27 if "vision_tower" in before else 18
        key = f"{before}{layers}{{{count}}}.{rest}" if layers else name
        if not layers or number == "0":
            tensors[f"model.paligemma_with_expert.{key}"] = list(tensor.shape)
    parameters = sum(p.numel() for p in model.parameters())
    source = "lerobot 0.6.1 PI0FastPolicy"
    facts = {"source": source, "parameters": parameters, "tied": [], "tensors": tensors}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(facts, indent=0) + "\n")


def main() -> None:
    torch.set_num_threads(1)
    tests = Path(__file__).parents[1]
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else tests / "golden"
    target.mkdir(parents=True, exist_ok=True)
    full_size(
        target / "keys.json" if len(sys.argv) > 1 else tests / "keys/pi0_fast-lerobot061.json"
    )
    Actions.folder = target / "fast"
    fit_actions(Actions.folder)
    shrink()
    modeling_pi0_fast.AutoTokenizer = tokenizer_processor.AutoTokenizer = Words
    modeling_pi0_fast.AutoProcessor = tokenizer_processor.AutoProcessor = Actions
    found = {name: tensor.contiguous() for name, tensor in numbers().items()}
    save_file(found, target / "lerobot061_pi0_fast.safetensors", VERSIONS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = {key: tensor.contiguous() for key, tensor in whole_policy(folder).items()}
        for file in folder.iterdir():
            if file.name not in ("model.safetensors", "README.md"):
                shutil.copyfile(file, target / f"lerobot061_pi0_fast-{file.name}")
    save_file(found, target / "lerobot061_pi0_fast_policy.safetensors", VERSIONS)


if __name__ == "__main__":
    main()
