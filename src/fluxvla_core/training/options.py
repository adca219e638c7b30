"""The settings of a train runner and of its data loaders, checked before anything is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fluxvla_core.build import RunContext, class_of
from fluxvla_core.config.resolve import LOADER_KEYS
from fluxvla_core.config.similar_keys import similar_key
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import VLA
from fluxvla_core.errors import ConfigError, Problem
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.training.lora import LoraOptions, check_installed, is_count, is_positive
from fluxvla_core.training.optimizers import make_schedule

DTYPES = ("bf16",)
SAVE_STEPS = 10_000
"""``save_iter_interval`` of step-based runs that do not set it."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """The settings of a train runner; its constructor and ``plugins show`` are made from them."""

    learning_rate: float
    """peak learning rate of the optimizer."""
    collator: Any
    """table of ``fluxvla.collators``, or a callable from samples to a batch."""
    max_epochs: int | None = None
    """exactly one of max_epochs and max_steps ends the run."""
    max_steps: int | None = None
    """exactly one of max_epochs and max_steps ends the run."""
    weight_decay: float = 0.0
    """of matrices; biases and norms have none."""
    max_grad_norm: float | None = 1.0
    """gradients are scaled down to this norm; None leaves them."""
    sampler: str | None = None
    """no effect; accepted because upstream FluxVLA's configs have it. None or ``distributed``: the
    samples are shuffled every epoch and divided over the ranks anyway."""
    tokenizer: Any = None
    """table of ``fluxvla.tokenizers``, saved with the checkpoints."""
    metric: Any = None
    """table of ``fluxvla.metrics``; a ``VLAMetric`` that writes JSON lines if None."""
    optimizer: Any = None
    """table of ``fluxvla.optimizers``; ``AdamW`` if None."""
    save_epoch_interval: int = 1
    """epoch-based runs save every N epochs."""
    save_iter_interval: int | None = None
    """save every N steps; 10000 in step-based runs that say nothing, only by epochs in
    epoch-based ones. The end of a run is always saved."""
    max_keep_ckpts: int = 2
    """newest checkpoints (by step) to keep; 0 keeps all."""
    async_save: bool = True
    """write checkpoints in the background while training continues, from a copy in memory; False
    waits for the disk and needs no copy."""
    lr_scheduler_type: str = "constant"
    """``constant``, ``linear-warmup+cosine-decay``, ``step-based``, ``wsd``."""
    lr_schedule: Mapping[Any, float] | None = None
    """for ``step-based``: ``{part of the run: rate}``, with 0."""
    warmup_ratio: float = 0.0
    """part of the run over which the rate rises linearly to ``learning_rate``."""
    grad_accumulation_steps: int = 1
    """batches per optimizer step; gradients are averaged over them."""
    enable_mixed_precision_training: bool = False
    """compute in ``mixed_precision_dtype``; weights and optimizer stay fp32."""
    mixed_precision_dtype: str = "bf16"
    """``bf16``."""
    enable_gradient_checkpointing: bool = False
    """recompute the model's ``fsdp_units`` in the backward pass."""
    compile_blocks: bool = False
    """``torch.compile`` each of the model's ``fsdp_units``."""
    init_from: str | None = None
    """weights to start from: a checkpoint's folder, a work dir, a safetensors file; a run that goes
    on has its own, or its adapter's base, instead."""
    lora: LoraOptions | Mapping[str, Any] | None = None
    """train low-rank adapters only: table of ``rank`` and, if wanted, ``target_modules``,
    ``modules_to_save`` (both are the model's own by default), ``alpha``, ``dropout``."""
    ema_decay: float | None = None
    """decay of averaged weights (EMA), which are kept too and used for inference; None: none."""
    val_iter_interval: int | None = None
    """with a ``val_dataloader``: its loss every N steps and at the end; None with every
    checkpoint. The best one by it is kept and called ``best``."""
    early_stop_patience: int | None = None
    """end after N validations in a row without a better one."""
    seed: int = 42
    """initial weights, order of samples, and everything drawn, also by datasets that set no
    ``seed`` of their own."""
    resume_from: str | None = None
    """``auto`` or a checkpoint's path; the command line's ``--resume`` goes first, but ``auto`` and
    restarts begin at that path while the work dir has no checkpoint."""
    log_iter_interval: int = 10
    """fetch losses, and look for NaN, every N steps; every step is logged all the same."""
    device: str = "auto"
    """``auto`` (a GPU if there is one), ``cpu``, ``cuda``."""
    peak_tflops: float | None = None
    """what one device can do at most, for ``mfu``; by default what the makers of known GPUs state
    for bf16."""

    def check(self, context: RunContext) -> None:
        """Refuse invalid values.

        Raises:
            ConfigError: every finding, with the place of its key.
        """
        found = [
            Problem(context.origins.get(f"{context.section}.{key}", ""), key, what)
            for key, what in self._problems()
        ]
        if found:
            raise ConfigError.from_problems(tuple(found))

    def _problems(self) -> list[tuple[str, str]]:
        problems: list[tuple[str, str]] = []

        def need(key: str, fine: bool, rule: str) -> None:
            if not fine:
                problems.append((key, f"{rule}, got {getattr(self, key)!r}"))

        if (self.max_epochs is None) == (self.max_steps is None):
            given = "both" if self.max_steps is not None else "none"
            problems.append(("max_epochs", f"give max_epochs or max_steps, got {given}"))
        for key in (
            "max_epochs",
            "max_steps",
            "save_iter_interval",
            "val_iter_interval",
            "early_stop_patience",
        ):
            value = getattr(self, key)
            need(key, value is None or is_count(value, 1), "must be a whole number above 0")
        for key in ("save_epoch_interval", "grad_accumulation_steps", "log_iter_interval"):
            need(key, is_count(getattr(self, key), 1), "must be a whole number above 0")
        need("max_keep_ckpts", is_count(self.max_keep_ckpts, 0), "must be 0 (keep all) or more")
        need("seed", is_count(self.seed, 0), "must be a whole number from 0 up")
        need("learning_rate", is_positive(self.learning_rate), "must be a positive number")
        need(
            "weight_decay",
            self.weight_decay == 0 or is_positive(self.weight_decay),
            "must be a number from 0 up",
        )
        need(
            "max_grad_norm",
            self.max_grad_norm is None or is_positive(self.max_grad_norm),
            "must be positive, or None for no clipping",
        )
        need(
            "ema_decay",
            self.ema_decay is None or (is_positive(self.ema_decay) and self.ema_decay < 1),
            "must be above 0 and below 1, or None",
        )
        need("sampler", self.sampler in (None, "distributed"), "must be None or 'distributed'")
        need("mixed_precision_dtype", self.mixed_precision_dtype in DTYPES, f"must be in {DTYPES}")
        need(
            "peak_tflops",
            self.peak_tflops is None or is_positive(self.peak_tflops),
            "must be a positive number, or None",
        )
        for key in (
            "async_save",
            "enable_mixed_precision_training",
            "enable_gradient_checkpointing",
            "compile_blocks",
        ):
            need(key, isinstance(getattr(self, key), bool), "must be true or false")
        try:
            make_schedule(self.lr_scheduler_type, 1.0, 100, self.warmup_ratio, self.lr_schedule)
        except ConfigError as error:
            problems.append(("lr_scheduler_type", error.what))
        return problems

    def lora_options(self, context: RunContext) -> LoraOptions | None:
        """The table ``lora``, checked; None without one.

        Raises:
            ConfigError: it is invalid, or peft is not installed.
        """
        if self.lora is None:
            return None
        where = context.where(f"{context.section}.lora")
        check_installed(where)
        table = context.config.get("model")
        kind = class_of(table.get("type"), VLAS) if isinstance(table, Mapping) else type(table)
        return LoraOptions.read(self.lora, where, implements(kind, VLA, "lora_defaults"))

    @property
    def save_steps(self) -> int | None:
        """Steps between checkpoints; None when only epochs count."""
        if self.save_iter_interval is None and self.max_steps is not None:
            return SAVE_STEPS
        return self.save_iter_interval


@dataclass(frozen=True)
class LoaderOptions:
    """``train_dataloader`` of the config, without its dataset.

    ``shuffle_episodes`` mixes N episodes at a time; None mixes all samples.
    """

    per_device_batch_size: int
    per_device_num_workers: int = 0
    shuffle_episodes: int | None = None

    @classmethod
    def for_validation(
        cls, config: Mapping[str, Any], context: RunContext, options: TrainOptions
    ) -> LoaderOptions | None:
        """``val_dataloader`` of the config, None without one; it takes over the batch size.

        Raises:
            ConfigError: it is invalid, or an option needs it and it is not there.
        """
        if config.get("val_dataloader") is None:
            for key in ("val_iter_interval", "early_stop_patience"):
                if getattr(options, key) is not None:
                    raise ConfigError(
                        f"{key} needs a val_dataloader, which the config does not have",
                        where=context.where(f"{context.section}.{key}"),
                        next="val_dataloader = dict(dataset=dict(type=…, episodes=[…]))",
                    )
            return None
        train = {k: v for k, v in config["train_dataloader"].items() if k != "dataset"}
        table = {**train, **config["val_dataloader"]}
        if table.get("dataset") is None:
            raise ConfigError(
                "val_dataloader needs a dataset", where=context.where("val_dataloader")
            )
        return cls.read({"val_dataloader": table}, context, "val_dataloader")

    @classmethod
    def read(
        cls, config: Mapping[str, Any], context: RunContext, section: str = "train_dataloader"
    ) -> LoaderOptions:
        """Take and check the table.

        Raises:
            ConfigError: it is missing, or has unknown keys or invalid values.
        """
        table = config.get(section)
        if not isinstance(table, Mapping):
            raise ConfigError(
                f"the config has no table {section!r}, which training needs",
                where=context.config_file,
                next=f"{section} = dict(per_device_batch_size=…, dataset=dict(type=…))",
            )
        problems: list[tuple[str, str]] = []
        for key in (key for key in table if key not in LOADER_KEYS):
            near = similar_key(key, LOADER_KEYS)
            hint = f"did you mean {near!r}?" if near else f"known: {', '.join(LOADER_KEYS)}"
            problems.append((key, f"unknown key; {hint}"))
        options = cls(
            table.get("per_device_batch_size", 0),
            table.get("per_device_num_workers", 0),
            table.get("shuffle_episodes"),
        )
        together = options.shuffle_episodes
        for key, fine, rule in (
            ("per_device_batch_size", is_count(options.per_device_batch_size, 1), "above 0"),
            ("per_device_num_workers", is_count(options.per_device_num_workers, 0), "from 0 up"),
            ("shuffle_episodes", together is None or is_count(together, 2), "above 1, or None"),
        ):
            if not fine:
                problems.append((key, f"must be a whole number {rule}, got {table.get(key)!r}"))
        if problems:
            raise ConfigError.from_problems(
                tuple(
                    Problem(context.origins.get(f"{section}.{k}", ""), f"{section}.{k}", what)
                    for k, what in problems
                )
            )
        return options
