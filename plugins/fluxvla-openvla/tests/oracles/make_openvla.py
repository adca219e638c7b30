"""Golden files from the authors' own code of OpenVLA; and its tensors' names.

By hand: a checkout of github.com/openvla/openvla (c8f03f4), and an environment with torch 2.13.0,
timm 0.9.16 and torchvision 0.28.0 (both without what they depend on), transformers 4.40.1,
tokenizers 0.19.1, safetensors and pillow. From the repository's root:

    OMP_NUM_THREADS=1 PYTHONPATH=.:CHECKOUT ENVIRONMENT/bin/python \\
        plugins/fluxvla-openvla/tests/oracles/make_openvla.py [FOLDER]

The models are tiny, but for the vocabulary, in which the code has fixed numbers. Every tensor is
filled from its published name, so that no weights are stored. ``--names`` instead of FOLDER writes
names and shapes of the full-size model to ``tests/keys``. ``bf16.`` is what it gives by autocast to
bfloat16.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import types
from collections.abc import Callable, Mapping
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
LENGTHS = (9, 6)
GRADIENTS = (
    "vision_backbone.featurizer.blocks.0.ls1.scale_factor",
    "vision_backbone.fused_featurizer.patch_embed.proj.bias",
    "projector.fc2.bias",
    "language_model.model.layers.0.mlp.up_proj.weight",
    "language_model.model.layers.1.self_attn.q_proj.weight",
    "language_model.model.norm.weight",
)


def main() -> None:
    """Write the golden files, or the names."""
    folder, names = asked()
    if names:
        _write_names()
        return
    write(folder, {"openvla": openvla, "processor": processor})


def asked() -> tuple[Path, bool]:
    """The folder for golden files, and whether names are to be written instead.

    The code that runs here reads the command line, too.
    """
    words, sys.argv = sys.argv[1:], sys.argv[:1]
    _make_importable()
    torch.set_num_threads(1)
    names = "--names" in words
    return Path(words[0]) if words and not names else HERE.parent / "golden", names


def write(folder: Path, parts: Mapping[str, Callable[[], Mapping[str, np.ndarray]]]) -> None:
    """Write a golden file of each of ``parts``."""
    import timm
    import transformers

    versions = {"torch": torch.__version__, "timm": timm.__version__}
    versions["transformers"] = transformers.__version__
    for name, compute in parts.items():
        torch.manual_seed(0)
        arrays = {key: np.ascontiguousarray(array) for key, array in compute().items()}
        save_file(arrays, folder / f"{name}.safetensors", versions)


def openvla() -> dict[str, np.ndarray]:
    """Token loss, its gradients and a decoded action."""
    model = tiny_vla()
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
    given = {
        "input_ids": batch,
        "attention_mask": batch.ne(32000),
        "pixel_values": images,
        "labels": pad(labels, batch_first=True, padding_value=-100),
    }
    loss = model(**given).loss
    loss.backward()
    found = {"loss": loss.detach().numpy()[None]}
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        found["bf16.loss"] = model(**given).loss.float().numpy()[None]
        found["bf16.features"] = model.vision_backbone(images).float().numpy()
    found |= gradients_of(model, GRADIENTS, "")
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


def tiny_vla() -> torch.nn.Module:
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
    fill_by_name(model, "")
    return model


def fill_by_name(part: torch.nn.Module, prefix: str) -> None:
    with torch.no_grad():
        for name, tensor in part.state_dict().items():
            tensor.copy_(torch.from_numpy(fill.weight(prefix + name, tensor.shape)))


def gradients_of(
    part: torch.nn.Module, names: tuple[str, ...], prefix: str
) -> dict[str, np.ndarray]:
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


def _make_importable() -> None:
    """Its packages without their ``__init__``, which import all of its training."""
    found = importlib.util.find_spec("prismatic")
    assert found is not None
    assert found.origin is not None
    root = Path(found.origin).parent
    for name in ("", ".extern", ".extern.hf", ".models", ".training", ".vla", ".util"):
        module = types.ModuleType(f"prismatic{name}")
        module.__path__ = [str(root.joinpath(*name.split(".")[1:]))]
        sys.modules[f"prismatic{name}"] = module


if __name__ == "__main__":
    main()
