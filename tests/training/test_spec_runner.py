"""The specification's MyTrainRunner, with its code as it stands there but for the imports."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Optional

import torch

from fluxvla_core import RUNNERS, BaseTrainRunner, build_runner_from_cfg
from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints.checkpoint import latest
from fluxvla_core.testing.training import KEYS, Notes, TinyDataset, tiny_config, train


@RUNNERS.register_module()
class MyTrainRunner(BaseTrainRunner):
    def __init__(self, my_custom_param: str = "default", *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.my_custom_param = my_custom_param

    def run_setup(self, n_train_examples: int) -> None:
        self.vla = self._build_vla()
        self.vla = self._wrap_model(self.vla)
        self.optimizer = self._build_optimizer()
        self.lr_scheduler = self._build_lr_scheduler(n_train_examples)

    def save_checkpoint(
        self,
        run_dir: Path,
        global_step: int,
        epoch: int,
        train_loss: Optional[float] = None,  # noqa: UP045
        only_trainable: bool = True,
    ) -> None:
        ckpt_path = run_dir / f"checkpoint_epoch_{epoch}.pt"
        torch.save(
            {
                "model_state_dict": self.vla.state_dict(),
                "optimizer_state_dict": self.optimizer.state_dict(),
                "epoch": epoch,
                "global_step": global_step,
            },
            ckpt_path,
        )

    def clip_grad_norm(self):
        torch.nn.utils.clip_grad_norm_(self.vla.parameters(), max_norm=self.max_grad_norm)

    def _load_model_state(self, checkpoint_model_state: dict) -> None:
        self.vla.load_state_dict(checkpoint_model_state, strict=False)

    def _load_optimizer_state(self, checkpoint_optimizer_state: dict) -> bool:
        self.optimizer.load_state_dict(checkpoint_optimizer_state)
        return True


def settings(work_dir, **more):
    collator = {"type": "DictCollator", "keys": list(KEYS), "meta_keys": ["prompt"]}
    table = {
        "type": "MyTrainRunner",
        "my_custom_param": "some_value",
        "learning_rate": 2e-5,
        "weight_decay": 0.0,
        "max_grad_norm": 1.0,
        "collator": collator,
        "metric": {"type": "VLAMetric", "active_trackers": ["jsonl"]},
        **more,
    }
    return {"config": tiny_config(table), "work_dir": str(work_dir)}


def test_it_runs_as_the_page_configures_it(tmp_path):
    runner = train(
        settings(
            tmp_path,
            max_epochs=2,
            enable_mixed_precision_training=True,
            mixed_precision_dtype="bf16",
        )
    )
    assert runner.my_custom_param == "some_value"
    assert runner.progress.step == 20
    assert sorted(p.name for p in tmp_path.glob("*.pt")) == [
        "checkpoint_epoch_1.pt",
        "checkpoint_epoch_2.pt",
    ]
    assert zipfile.is_zipfile(tmp_path / "checkpoint_epoch_2.pt")
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 20


def test_its_loading_goes_on_from_a_checkpoint_of_the_base_class(tmp_path):
    base = settings(tmp_path, type="OneProcessRunner", max_steps=4)
    del base["config"]["runner"]["my_custom_param"]
    train(base)
    other = {**base, "work_dir": str(tmp_path / "more")}
    other["config"] = {
        **base["config"],
        "runner": {**base["config"]["runner"], "max_steps": 8},
    }
    train(other)
    config = settings(tmp_path, max_steps=8)["config"]
    context = RunContext(
        config=config,
        section="runner",
        work_dir=tmp_path,
        resume="auto",
        reporter=Notes(tmp_path),
    )
    runner = build_runner_from_cfg(config["runner"], context)
    runner.run_setup(37)
    runner.run(TinyDataset())
    whole = latest(tmp_path / "more").tensors("model.safetensors")
    # Its clipping adds the norms up in another order than the base class does.
    pairs = [(t, whole[n]) for n, t in runner.vla.state_dict().items()]
    assert all(torch.allclose(a, b, rtol=0, atol=1e-6) for a, b in pairs)
    assert "resuming from" in (tmp_path / "said.txt").read_text()
