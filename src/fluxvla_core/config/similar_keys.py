"""The config key that was probably meant by an unknown one, also by other frameworks' names.

The names are those of Hugging Face's Trainer, LeRobot, openpi, Lightning and torch.
"""

from __future__ import annotations

from collections.abc import Iterable

from fluxvla_core.errors import nearest

_OTHER_NAMES = {
    # train runners
    "learning_rate": ("lr", "peak_lr", "max_lr"),
    "lr_scheduler_type": ("lr_scheduler", "scheduler", "schedule"),
    "warmup_ratio": (
        *("warmup", "warmup_steps", "num_warmup_steps", "lr_warmup_steps", "warmup_iters"),
        *("warmup_epochs", "lr_warmup", "warmup_fraction"),
    ),
    "max_steps": ("steps", "train_steps", "num_train_steps", "total_steps", "iterations"),
    "max_epochs": ("epochs", "num_epochs", "num_train_epochs"),
    "grad_accumulation_steps": ("accumulate_grad_batches", "gradient_accumulation_steps"),
    "max_grad_norm": ("gradient_clip_val", "clip_grad_norm", "grad_clip_norm", "grad_clip"),
    "enable_mixed_precision_training": ("bf16", "fp16", "use_amp", "amp", "mixed_precision"),
    "mixed_precision_dtype": ("precision", "dtype", "torch_dtype"),
    "enable_gradient_checkpointing": ("gradient_checkpointing", "activation_checkpointing"),
    "compile_blocks": ("torch_compile", "compile", "compile_model"),
    "save_iter_interval": ("save_steps", "save_freq", "save_interval", "save_every_n_steps"),
    "max_keep_ckpts": ("save_total_limit", "save_top_k", "keep_last", "max_to_keep"),
    "log_iter_interval": ("logging_steps", "log_freq", "log_interval", "log_every_n_steps"),
    "val_iter_interval": ("eval_steps", "eval_freq", "val_freq", "val_check_interval"),
    "early_stop_patience": ("patience", "early_stopping_patience", "early_stopping"),
    "ema_decay": ("ema", "use_ema", "ema_power"),
    "lora": ("peft", "use_lora", "use_peft", "lora_config"),
    "metric": ("wandb", "report_to", "logger", "loggers", "log_with"),
    "resume_from": ("resume", "resume_from_checkpoint"),
    "init_from": ("pretrained_path", "pretrained_checkpoint", "load_from", "weight_loader"),
    "optimizer": ("optim", "optimizer_type"),
    # data
    "per_device_batch_size": ("batch_size", "train_batch_size", "per_device_train_batch_size"),
    "per_device_num_workers": ("num_workers", "dataloader_num_workers"),
    "data_root_path": ("repo_id", "root", "dataset_path", "data_dir"),
    "action_window_size": ("chunk_size", "action_horizon", "action_chunk_size", "horizon"),
    "img_keys": ("image_keys", "cameras", "camera_keys"),
    # evaluation and inference
    "ckpt_path": ("checkpoint", "checkpoint_path", "policy_path", "pretrained_path"),
    "episodes": ("n_episodes", "num_episodes", "num_trials"),
    "workers": ("num_workers", "num_envs", "n_envs"),
    "execute_horizon": ("n_action_steps", "replan_steps", "open_loop_horizon"),
    "publish_rate": ("fps", "control_hz", "frequency", "control_frequency"),
}
_SHARE = "the share of the run's steps, from 0 to 1"
_NOTES = {("warmup_ratio", name): _SHARE for name in _OTHER_NAMES["warmup_ratio"]}


def similar_key(name: str, known: Iterable[str], least: float = 0.6) -> str | None:
    """The key of ``known`` that ``name`` is called elsewhere, else the most similar; None if none.

    Args:
        least: similarity, from 0 to 1, below which a key is not close.
    """
    known = list(known)
    meant = (key for key, others in _OTHER_NAMES.items() if name in others and key in known)
    return next(meant, None) or nearest(name, known, least)


def unit_note(name: str, key: str) -> str:
    """What the value of ``key`` means where that of ``name`` means something else; else empty."""
    return _NOTES.get((key, name), "")
