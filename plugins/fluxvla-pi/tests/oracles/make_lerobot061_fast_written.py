"""What LeRobot 0.6.1 does with the folder of a tiny PI0-FAST that FluxVLA writes.

    HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 PYTHONPATH=. python \\
        plugins/fluxvla-pi/tests/oracles/make_lerobot061_fast_written.py [FOLDER]

``tests/written/pi0_fast`` is what ``fluxvla export --format lerobot`` makes, without the weights;
test_lerobot_fast_write.py compares. They are filled by their names here. Sizes and tokenizers are
those of ``make_lerobot061_fast.py``, and the tokenizer of actions is the one beside the config, in
the folder that the config names.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import pi_inputs as tiny
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.processor import tokenizer_processor
from make_lerobot061 import VERSIONS
from make_lerobot061_fast import Actions, Words, shrink
from safetensors.torch import save_file

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
TESTS = Path(__file__).parents[1]
WRITTEN = TESTS / "written" / "pi0_fast"


class Beside(Actions):
    """The tokenizer of actions in the folder that is asked for."""

    @classmethod
    def from_pretrained(cls, name: str, **settings):
        cls.folder = WRITTEN / name
        return super().from_pretrained(name)


def results(folder: Path) -> dict[str, torch.Tensor]:
    """Let the written policy act, as ``make_lerobot061_fast.py`` its own."""
    shutil.copytree(WRITTEN, folder, dirs_exist_ok=True)
    config = PreTrainedConfig.from_pretrained(folder)
    fresh = modeling_pi0_fast.PI0FastPolicy(config).state_dict()
    weights = {
        name: torch.from_numpy(fill.weight(name, tuple(tensor.shape)))
        for name, tensor in fresh.items()
    }
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    policy = modeling_pi0_fast.PI0FastPolicy.from_pretrained(folder, strict=True).eval()
    loaded = policy.state_dict()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in weights.items())
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    images, state = tiny.observation()
    raw = {
        f"observation.images.{name}": torch.from_numpy(image).permute(2, 0, 1) / 255.0
        for name, image in images.items()
    }
    raw |= {"observation.state": torch.from_numpy(state), "task": tiny.TASKS["pi05"]}
    trained = before({**raw, "action": torch.from_numpy(tiny.chunk())})
    batch = before(raw)
    words = (batch["observation.language.tokens"], batch["observation.language.attention_mask"])
    with torch.no_grad():
        answer = policy.model.sample_actions_fast_kv_cache(
            *policy._preprocess_images(batch), *words, tiny.FAST_STEPS
        )
        commands = after(policy.predict_action_chunk(batch))
    return {"action_tokens": trained["action.tokens"], "answer": answer, "commands": commands}


def main() -> None:
    torch.set_num_threads(1)
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else TESTS / "golden"
    target.mkdir(parents=True, exist_ok=True)
    shrink()
    modeling_pi0_fast.AutoTokenizer = tokenizer_processor.AutoTokenizer = Words
    modeling_pi0_fast.AutoProcessor = tokenizer_processor.AutoProcessor = Beside
    with tempfile.TemporaryDirectory() as name:
        found = {key: tensor.contiguous() for key, tensor in results(Path(name)).items()}
    save_file(found, target / "lerobot061_pi0_fast_written.safetensors", VERSIONS)


if __name__ == "__main__":
    main()
