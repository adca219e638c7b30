"""Golden files from the authors' own code of OpenVLA-OFT; and a file's tensors' names.

By hand: checkouts of github.com/moojink/openvla-oft (213c5ff) and of
github.com/moojink/transformers-openvla-oft (bc339d9), and an environment with make_openvla.py's
packages and diffusers, but without transformers. From the repository's root:

    OMP_NUM_THREADS=1 PYTHONPATH=.:CHECKOUT:TRANSFORMERS/src ENVIRONMENT/bin/python \\
        plugins/fluxvla-openvla/tests/oracles/make_openvla_oft.py [FOLDER]

Sizes and inputs are those of make_openvla.py. ``--names`` instead of FOLDER writes names and shapes
of the tiny model's ``vision_backbone--…`` to ``tests/keys``; that takes peft 0.11.1, too.
"""

from __future__ import annotations

import json

import numpy as np
import torch
from make_openvla import (
    GRADIENTS,
    HERE,
    PATCHES,
    asked,
    fill_by_name,
    gradients_of,
    pictures,
    prompts,
    tiny_vla,
    write,
)

from tests.oracles import fill

OF_HEAD = ("model.fc1.bias", "model.mlp_resnet_blocks.1.ffn.1.weight")
OF_STATE = ("fc1.weight",)
OF_FILM = ("vision_backbone.featurizer.blocks.1.scale.bias",)
UNIT = {"q01": -1.0, "q99": 1.0, "min": -1.0, "max": 1.0}


def main() -> None:
    """Write the golden files, or the names."""
    folder, names = asked()
    if names:
        _write_names()
        return
    write(folder, {"oft": oft, "film": film, "diffusion": diffusion})


def oft() -> dict[str, np.ndarray]:
    """L1 loss with the state and two images; gradients and predicted chunks."""
    found = _oft(film=False, diffuse=False)
    with torch.autocast("cpu", torch.bfloat16):
        lower = _oft(film=False, diffuse=False)
    return {**found, **{f"bf16.{name}": lower[name] for name in ("loss", "losses", "predicted")}}


def film() -> dict[str, np.ndarray]:
    """The same with FiLM."""
    return _oft(film=True, diffuse=False)


def diffusion() -> dict[str, np.ndarray]:
    """The same with the diffusion head, in 50 and in 10 steps."""
    return _oft(film=False, diffuse=True)


def _oft(film: bool, diffuse: bool) -> dict[str, np.ndarray]:
    from prismatic.models import action_heads, projectors
    from prismatic.models.film_vit_wrapper import FiLMedPrismaticVisionBackbone

    model = tiny_vla()
    if film:
        model.vision_backbone = FiLMedPrismaticVisionBackbone(model.vision_backbone, 32)
    model.vision_backbone.set_num_images_in_input(2)
    kind = action_heads.DiffusionActionHead if diffuse else action_heads.L1RegressionActionHead
    head = kind(input_dim=32, hidden_dim=32, action_dim=7)
    state = projectors.ProprioProjector(32, 8)
    noisy = projectors.NoisyActionProjector(32) if diffuse else None
    for part, prefix in ((model, ""), (head, "action_head."), (state, "proprio_projector.")):
        fill_by_name(part, prefix)
    if noisy is not None:
        fill_by_name(noisy, "noisy_action_projector.")
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
            errors = (head.predict_noise(chosen) - noise[row : row + 1]).square()
        else:
            errors = (head.predict_action(chosen) - actions[row : row + 1]).abs()
        losses.append(errors.float().mean())
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
    names = OF_FILM if film else GRADIENTS
    found |= gradients_of(model.vision_backbone if film else model, names, "")
    found |= gradients_of(state, OF_STATE, "proprio_projector.")
    if not diffuse:
        found |= gradients_of(head, OF_HEAD, "action_head.")
    found["predicted"] = np.stack(chunks).astype(np.float32)
    if diffuse:
        found["predicted in 10 steps"] = np.stack(quick).astype(np.float32)
    return found


def _write_names() -> None:
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
    model = get_peft_model(tiny_vla(), settings)
    wrapped = FiLMedPrismaticVisionBackbone(model.vision_backbone, 32)
    shapes = {name: list(tensor.shape) for name, tensor in wrapped.state_dict().items()}
    lines = ",\n".join(f"{json.dumps(name)}: {shape}" for name, shape in shapes.items())
    (HERE.parent / "keys" / "openvla-oft-film-tiny.json").write_text(f"{{\n{lines}\n}}\n")
    print(len(shapes))


if __name__ == "__main__":
    main()
