"""A training runner, as the page 'Adding Custom Engines' writes it.

It replaces every part that it may: the wrapping of the model, the checkpoint's format, the clipping
and the loading. A strategy that is content with the core's checkpoints overrides ``_wrap_model``
alone.
"""
# The code below is the page's, in its own style.
# ruff: noqa
# fmt: off

from pathlib import Path
from typing import Optional

import torch

from fluxvla_core import BaseTrainRunner


class MyTrainRunner(BaseTrainRunner):
    """A custom training runner."""

    def __init__(self,
                 my_custom_param: str = 'default',
                 *args, **kwargs) -> None:
        # The base class takes the standard parameters.
        super().__init__(*args, **kwargs)
        self.my_custom_param = my_custom_param

    def run_setup(self, n_train_examples: int) -> None:
        """Set up the model, the optimizer and the learning-rate schedule."""
        # 1. The VLA model.
        self.vla = self._build_vla()

        # 2. The strategy: wrap the model (DeepSpeed, pipeline, ...).
        self.vla = self._wrap_model(self.vla)

        # 3. The optimizer.
        self.optimizer = self._build_optimizer()

        # 4. The schedule.
        self.lr_scheduler = self._build_lr_scheduler(n_train_examples)

    def save_checkpoint(self,
                        run_dir: Path,
                        global_step: int,
                        epoch: int,
                        train_loss: Optional[float] = None,
                        only_trainable: bool = True) -> None:
        """Save a checkpoint in a format of one's own."""
        ckpt_path = run_dir / f'checkpoint_epoch_{epoch}.pt'
        torch.save({
            'model_state_dict': self.vla.state_dict(),
            'optimizer_state_dict': self.optimizer.state_dict(),
            'epoch': epoch,
            'global_step': global_step,
        }, ckpt_path)

    def clip_grad_norm(self):
        """Clip the gradients."""
        torch.nn.utils.clip_grad_norm_(
            self.vla.parameters(), max_norm=self.max_grad_norm)

    def _load_model_state(self, checkpoint_model_state: dict) -> None:
        """Load the model's weights from a checkpoint."""
        self.vla.load_state_dict(checkpoint_model_state, strict=False)

    def _load_optimizer_state(self, checkpoint_optimizer_state: dict) -> bool:
        """Load the optimizer's state from a checkpoint."""
        self.optimizer.load_state_dict(checkpoint_optimizer_state)
        return True
