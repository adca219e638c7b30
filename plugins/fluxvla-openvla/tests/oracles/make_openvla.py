"""Golden files from the authors' own code of OpenVLA and OpenVLA-OFT; and their tensors' names.

In an environment with torch 2.13.0, timm 0.9.16, torchvision 0.28.0 (its compiled part is not
needed), transformers 4.40.1, tokenizers 0.19.1, diffusers, safetensors and pillow, with a copy of
each repository:

    git clone https://github.com/openvla/openvla             (c8f03f4)
    git clone https://github.com/moojink/openvla-oft         (213c5ff)
    git clone https://github.com/moojink/transformers-openvla-oft   (bc339d9)

    PYTHONPATH=. python plugins/fluxvla-openvla/tests/oracles/make_openvla.py openvla openvla
    (the same with processor, or names, instead of openvla)
    PYTHONPATH=.:transformers-openvla-oft/src python … make_openvla.py oft openvla-oft
    PYTHONPATH=.:transformers-openvla-oft/src python … make_openvla.py film openvla-oft
    PYTHONPATH=.:transformers-openvla-oft/src python … make_openvla.py diffusion openvla-oft

from the root of this repository. The models are tiny, but for the vocabulary, in which the code has
fixed numbers. Every tensor is filled from its published name, so that no weights are stored.
"""

from __future__ import annotations

import argparse
import json
import sys
import types
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

from tests.oracles import fill

HERE = Path(__file__).parent
DINO = {"embed_dim": 32, "depth": 3, "num_heads": 2, "mlp_ratio": 2.0}
SIGLIP = {"embed_dim": 48, "depth": 3, "num_heads": 3, "mlp_ratio": 2.0}
LLAMA = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "vocab_size": 32064,
    "pad_token_id": 32000,
}
IMAGE, PATCHES = 28, 4
PARTS = ("openvla", "oft", "film", "diffusion", "processor")
LENGTHS = (9, 6)
GRADIENTS = {
    "openvla": (
        "vision_backbone.featurizer.blocks.0.ls1.scale_factor",
        "vision_backbone.fused_featurizer.patch_embed.proj.bias",
        "projector.fc2.bias",
        "language_model.model.layers.0.mlp.up_proj.weight",
        "language_model.model.layers.1.self_attn.q_proj.weight",
        "language_model.model.norm.weight",
    ),
    "action_head": ("model.fc1.bias", "model.mlp_resnet_blocks.1.ffn.1.weight"),
    "proprio_projector": ("fc1.weight",),
    "film": ("vision_backbone.featurizer.blocks.1.scale.bias",),
}


def main() -> None:
    """Write one golden file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("which", choices=(*PARTS, "names", "film_names"))
    parser.add_argument("repository", type=Path)
    options = parser.parse_args()
    sys.argv = sys.argv[:1]
    torch.manual_seed(0)
    torch.set_num_threads(1)
    _make_importable(options.repository)
    if options.which.endswith("names"):
        {"names": _write_names, "film_names": _write_film_names}[options.which]()
        return
    arrays = globals()[options.which]()
    import timm
    import transformers

    versions = {"torch": torch.__version__, "timm": timm.__version__}
    versions["transformers"] = transformers.__version__
    file = HERE.parent / "golden" / f"{options.which}.safetensors"
    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, file, versions)
    for name, array in arrays.items():
        print(name, array.shape, float(np.abs(array).mean()))


def openvla() -> dict[str, np.ndarray]:
    """Token loss, its gradients and a decoded action."""
    model = _vla()
    ids, masks = prompts()
    images, actions = pictures(1), fill.uniform("actions", (2, 7), -1.2, 1.2)
    edges = np.linspace(-1, 1, 256)
    tokens = 32000 - np.digitize(np.clip(actions, -1, 1), edges)
    rows, labels = [], []
    for prompt, mask, action in zip(ids, masks, tokens, strict=True):
        real = prompt[mask]
        rows.append(torch.tensor([*real, *action, 2]))
        labels.append(torch.tensor([*[-100] * len(real), *action, 2]))
    pad = torch.nn.utils.rnn.pad_sequence
    batch = pad(rows, batch_first=True, padding_value=32000)
    output = model(
        input_ids=batch,
        attention_mask=batch.ne(32000),
        pixel_values=images,
        labels=pad(labels, batch_first=True, padding_value=-100),
    )
    output.loss.backward()
    found = {"loss": output.loss.detach().numpy()[None]}
    found |= _gradients(model, GRADIENTS["openvla"], "")
    model.norm_stats = {"unit": {"action": {"q01": [-1.0] * 7, "q99": [1.0] * 7}}}
    with torch.no_grad():
        # Only actions' tokens are ever likely, as in a trained model.
        model.language_model.lm_head.weight[:31744] *= 1e-3
        model.language_model.lm_head.weight[32000:] *= 1e-3
        chosen = []
        for row in range(2):
            chosen.append(
                model.predict_action(
                    torch.tensor(ids[row][masks[row]])[None],
                    pixel_values=images[row : row + 1],
                    do_sample=False,
                )
            )
    found["predicted"] = np.stack(chosen).astype(np.float32)
    found["features"] = model.vision_backbone(images).detach().numpy()
    return found


def oft() -> dict[str, np.ndarray]:
    """L1 loss with the state and two images; gradients and predicted chunks."""
    return _oft(film=False, diffuse=False)


def film() -> dict[str, np.ndarray]:
    """The same with FiLM."""
    return _oft(film=True, diffuse=False)


def diffusion() -> dict[str, np.ndarray]:
    """The same with the diffusion head, in 50 and in 10 steps."""
    return _oft(film=False, diffuse=True)


def processor() -> dict[str, np.ndarray]:
    """An image through the published processor, to 28 pixels instead of 224."""
    from PIL import Image
    from prismatic.extern.hf.processing_prismatic import PrismaticImageProcessor

    made = PrismaticImageProcessor(
        use_fused_vision_backbone=True,
        image_resize_strategy="resize-naive",
        input_sizes=[(3, IMAGE, IMAGE)] * 2,
        interpolations=["bicubic"] * 2,
        means=[(0.485, 0.456, 0.406), (0.5, 0.5, 0.5)],
        stds=[(0.229, 0.224, 0.225), (0.5, 0.5, 0.5)],
    )
    picture = Image.fromarray(fill.integers("picture", (48, 64, 3), 256).astype(np.uint8))
    return {"pixel_values": made.apply_transform(picture).numpy()}


def _oft(film: bool, diffuse: bool) -> dict[str, np.ndarray]:
    from prismatic.models import action_heads, projectors
    from prismatic.models.film_vit_wrapper import FiLMedPrismaticVisionBackbone

    model = _vla()
    if film:
        model.vision_backbone = FiLMedPrismaticVisionBackbone(model.vision_backbone, 32)
    model.vision_backbone.set_num_images_in_input(2)
    kind = action_heads.DiffusionActionHead if diffuse else action_heads.L1RegressionActionHead
    head = kind(input_dim=32, hidden_dim=32, action_dim=7)
    state = projectors.ProprioProjector(32, 8)
    noisy = projectors.NoisyActionProjector(32) if diffuse else None
    for part, prefix in ((model, ""), (head, "action_head."), (state, "proprio_projector.")):
        _fill(part, prefix)
    if noisy is not None:
        _fill(noisy, "noisy_action_projector.")
    ids, masks = prompts()
    images = pictures(2)
    actions = torch.from_numpy(fill.uniform("actions", (2, 8, 7), -1.0, 1.0))
    states = torch.from_numpy(fill.uniform("states", (2, 8), -1.0, 1.0))
    noise = torch.from_numpy(fill.normal("noise", (2, 8, 7)))
    steps = torch.tensor([3, 41])
    losses, chunks, quick = [], [], []
    # One by one: in a batch its FiLM averages padding, too.
    for row in range(2):
        real = ids[row][masks[row]]
        batch = torch.tensor([*real, *[31900] * 56, 2])[None]
        labels = torch.tensor([*[-100] * len(real), *[31900] * 56, 2])[None]
        extra = {}
        if diffuse:
            noised = head.noise_scheduler.add_noise(
                actions[row : row + 1], noise[row : row + 1], steps[row : row + 1]
            )
            extra = {
                "noisy_actions": noised,
                "noisy_action_projector": noisy,
                "diffusion_timestep_embeddings": head.time_encoder(steps[row : row + 1])[:, None],
            }
        output = model(
            input_ids=batch,
            attention_mask=torch.ones_like(batch),
            pixel_values=images[row : row + 1],
            labels=labels,
            output_hidden_states=True,
            proprio=states[row : row + 1],
            proprio_projector=state,
            use_film=film,
            **extra,
        )
        front = 2 * PATCHES + 1 + diffuse
        text = output.hidden_states[-1][:, front:-1]
        chosen = text[:, (labels[:, 1:] > 31743)[0]]
        if diffuse:
            losses.append((head.predict_noise(chosen) - noise[row : row + 1]).square().mean())
        else:
            losses.append((head.predict_action(chosen) - actions[row : row + 1]).abs().mean())
        model.norm_stats = {"unit": {"action": {k: [s] * 7 for k, s in UNIT.items()}}}
        for taken, count in ((chunks, 50), (quick, 10)):
            if diffuse:
                head.noise_scheduler.set_timesteps(count)
            drawn, normal = noise[row : row + 1], torch.randn
            torch.randn = lambda *_, drawn=drawn, **__: drawn
            with torch.no_grad():
                chunk, _ = model.predict_action(
                    torch.tensor(real)[None],
                    pixel_values=images[row : row + 1],
                    attention_mask=torch.ones(1, len(real), dtype=torch.long),
                    proprio=states[row].numpy(),
                    proprio_projector=state,
                    action_head=head,
                    noisy_action_projector=noisy,
                    use_film=film,
                )
            torch.randn = normal
            taken.append(chunk)
    loss = torch.stack(losses).mean()
    loss.backward()
    found = {"loss": loss.detach().numpy()[None], "losses": torch.stack(losses).detach().numpy()}
    names = GRADIENTS["openvla"] if not film else GRADIENTS["film"]
    found |= _gradients(model.vision_backbone if film else model, names, "")
    found |= _gradients(state, GRADIENTS["proprio_projector"], "proprio_projector.")
    if not diffuse:
        found |= _gradients(head, GRADIENTS["action_head"], "action_head.")
    found["predicted"] = np.stack(chunks).astype(np.float32)
    if diffuse:
        found["predicted in 10 steps"] = np.stack(quick).astype(np.float32)
    return found


UNIT = {"q01": -1.0, "q99": 1.0, "min": -1.0, "max": 1.0}


def prompts() -> tuple[np.ndarray, np.ndarray]:
    """Two prompts ``(2, 9)`` of 9 and 6 tokens, padded on the right, and their masks."""
    ids = 3 + fill.integers("prompts", (2, 9), 30000)
    masks = np.arange(9)[None] < np.array(LENGTHS)[:, None]
    ids[:, 0] = 1
    for row, length in enumerate(LENGTHS):
        ids[row, length - 1] = 29871
    return np.where(masks, ids, 0), masks


def pictures(count: int) -> torch.Tensor:
    """Two observations of ``count`` images, ``(2, 6 * count, H, W)``: for DINOv2, for SigLIP."""
    plain = fill.uniform("images", (2, count, 3, IMAGE, IMAGE), -1.0, 1.0)
    mean = np.array([0.485, 0.456, 0.406], np.float32)[:, None, None]
    std = np.array([0.229, 0.224, 0.225], np.float32)[:, None, None]
    both = np.concatenate([(plain * 0.5 + 0.5 - mean) / std, plain], 2)
    return torch.from_numpy(both.reshape(2, 6 * count, IMAGE, IMAGE).astype(np.float32))


def _vla() -> torch.nn.Module:
    import timm
    from prismatic.extern.hf.configuration_prismatic import OpenVLAConfig
    from prismatic.extern.hf.modeling_prismatic import OpenVLAForActionPrediction

    create = timm.create_model
    sizes = iter((DINO, SIGLIP))
    timm.create_model = lambda name, **settings: create(name, **{**settings, **next(sizes)})
    config = OpenVLAConfig(vision_backbone_id="dinosiglip-vit-so-224px", text_config=LLAMA)
    config.image_sizes = [IMAGE, IMAGE]
    config._attn_implementation = "sdpa"
    model = OpenVLAForActionPrediction(config).eval()
    timm.create_model = create
    _fill(model, "")
    return model


def _fill(part: torch.nn.Module, prefix: str) -> None:
    with torch.no_grad():
        for name, tensor in part.state_dict().items():
            tensor.copy_(torch.from_numpy(fill.weight(prefix + name, tensor.shape)))


def _gradients(part: torch.nn.Module, names: tuple[str, ...], prefix: str) -> dict[str, np.ndarray]:
    parameters = dict(part.named_parameters())
    return {f"gradient {prefix}{name}": parameters[name].grad.numpy() for name in names}


def _write_names() -> None:
    """Names and shapes of OpenVLA-7B's tensors, from a model without memory."""
    from prismatic.extern.hf.configuration_prismatic import OpenVLAConfig
    from prismatic.extern.hf.modeling_prismatic import OpenVLAForActionPrediction

    linspace = torch.linspace
    torch.linspace = lambda *args, **settings: linspace(*args, **{**settings, "device": "cpu"})
    text = {"vocab_size": 32064, "pad_token_id": 32000}
    config = OpenVLAConfig(vision_backbone_id="dinosiglip-vit-so-224px", text_config=text)
    with torch.device("meta"):
        model = OpenVLAForActionPrediction(config)
    shapes = {name: list(tensor.shape) for name, tensor in model.state_dict().items()}
    lines = ",\n".join(f"{json.dumps(name)}: {shape}" for name, shape in shapes.items())
    (HERE.parent / "keys" / "openvla-7b.json").write_text(f"{{\n{lines}\n}}\n")
    print(len(shapes), sum(int(np.prod(shape)) for shape in shapes.values()))


def _write_film_names() -> None:
    """Names and shapes of the tiny model's ``vision_backbone--…``, with peft 0.11.1."""
    from peft import LoraConfig, get_peft_model
    from prismatic.models.film_vit_wrapper import FiLMedPrismaticVisionBackbone

    settings = LoraConfig(
        r=32,
        lora_alpha=16,
        lora_dropout=0.0,
        target_modules="all-linear",
        init_lora_weights="gaussian",
    )
    model = get_peft_model(_vla(), settings)
    wrapped = FiLMedPrismaticVisionBackbone(model.vision_backbone, 32)
    shapes = {name: list(tensor.shape) for name, tensor in wrapped.state_dict().items()}
    lines = ",\n".join(f"{json.dumps(name)}: {shape}" for name, shape in shapes.items())
    (HERE.parent / "keys" / "openvla-oft-film-tiny.json").write_text(f"{{\n{lines}\n}}\n")
    print(len(shapes))


def _make_importable(repository: Path) -> None:
    """Its packages without their ``__init__``, which import all of its training."""
    root = repository / "prismatic"
    for name in ("", ".extern", ".extern.hf", ".models", ".training", ".vla", ".util"):
        module = types.ModuleType(f"prismatic{name}")
        module.__path__ = [str(root.joinpath(*name.split(".")[1:]))]
        sys.modules[f"prismatic{name}"] = module


if __name__ == "__main__":
    main()
