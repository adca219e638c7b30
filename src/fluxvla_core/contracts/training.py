"""The contracts of training: model, dataset, transform, collator, tokenizer, metric, optimizer.

Nothing here imports torch: ``VLA`` is inherited together with ``torch.nn.Module``.
"""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.contracts.contract import Contract, attribute
from fluxvla_core.contracts.frame import Sample
from fluxvla_core.spec import EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class PartWeights:
    """Published weights of a part of a model, under the names that they have there.

    Args:
        place: a safetensors file, a folder of them, ``hf:<id>``, or a file of ``torch.save``.
        names: a part of our weights' names -> its replacement in the file. The longest match
            counts; weights without a match are not in the file.
        unread: parts of names in the file that are not needed. Any other weight that is left over
            is an error, and so is one that is missing.
    """

    place: str
    names: Mapping[str, str]
    unread: Sequence[str] = ()


Size = int | tuple[int, int] | str | tuple[str, Callable[[Any], Any]] | None


@dataclass(frozen=True)
class InputSizes:
    """Sizes of the batches that a model takes, as arguments of its constructor say them.

    Data, robots and checkpoints are compared with them before a model is built. Each is the name of
    an argument (``vla_head.horizon``: of the table ``vla_head``; ``a | b``: of the first that is
    set), a number or two, or such a name and a function of the value. None is any size, also as a
    value.

    Args:
        cameras: images of an observation.
        image_size: pixels of a side, or height and width.
        states, actions: numbers of a state and of an action, behind the transforms.
        horizon: actions of a chunk.
        embodiments: robots that there are weights for; ``embodiment_ids`` are below it.
        vocabulary: tokens that the model embeds; ``lang_tokens`` are below it.
        n_obs_steps, past_actions: as of ``VLA``.
        float_images: images are floats, which a transform has to make of bytes.
    """

    cameras: Size = None
    image_size: Size = None
    states: Size = None
    actions: Size = None
    horizon: Size = None
    embodiments: Size = None
    vocabulary: Size = None
    n_obs_steps: Size = None
    past_actions: Size = None
    float_images: bool = False


class VLA(Contract):
    """A model, with the facts that training strategies need: ``class MyVLA(VLA, nn.Module)``.

    It has ``forward(...)`` for training, whose parameters are keys of a batch, or
    ``predict_action(...)`` for acting.
    """

    forward: Callable[..., Any]
    input_sizes: ClassVar[InputSizes] = InputSizes()
    """The sizes of its batches, by which data that do not fit are refused before it is built."""
    _together: ClassVar[tuple[tuple[str, ...], ...]] = (("observe", "denoise"),)

    def batch_keys(self) -> Mapping[str, bool] | None:
        """Keys of a batch that ``forward`` takes, and whether each must be there; None takes all.

        By default the parameters of ``forward``; those without a default must be there.
        """
        parameters = inspect.signature(self.forward).parameters.values()
        if any(p.kind is p.VAR_KEYWORD for p in parameters):
            return None
        named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        return {p.name: p.default is p.empty for p in named}

    @attribute
    def action_shape(self) -> tuple[int, int] | None:
        """``(horizon, dim)`` of a chunk; None where the dataset says how long one is."""
        return None

    @attribute
    def n_obs_steps(self) -> int:
        """Observations that it takes, one action apart, the present one last.

        With more than one, ``images`` are ``(B, n_obs_steps, 3N, H, W)`` and ``states``
        ``(B, n_obs_steps, S)``, in training and when it acts; all else is the present one's.
        """
        return 1

    @attribute
    def past_actions(self) -> int:
        """Actions of a chunk before the present one's: they are trained on, and left out of a
        policy's answers. A policy with such actions cannot continue a chunk (``rtc``)."""
        return 0

    @attribute
    def static_graph(self) -> bool:
        """Whether every step uses the same parameters in the same order, as DDP may rely on."""
        return False

    @attribute
    def frozen_source(self) -> str | None:
        """The origin of the frozen weights when the model is built (a package, a file).

        They are not saved in checkpoints, only their hash. None: they are saved. Any module inside
        the model may have this attribute for its own frozen weights.
        """
        return None

    @attribute
    def pretrained_name_or_path(self) -> str | None:
        """The weights that a training starts from: what ``runner.init_from`` takes, for instance
        another project's checkpoint. The trainer reads them, not the constructor; resuming from a
        checkpoint of the training overwrites them."""
        return None

    @attribute
    def part_weights(self) -> Sequence[PartWeights]:
        """Parts that a training starts from published weights of their own, where neither
        ``runner.init_from`` nor ``pretrained_name_or_path`` names weights of the whole model."""
        return ()

    @attribute
    def lora_defaults(self) -> Mapping[str, Any]:
        """Values of a train runner's table ``lora`` that names no ``target_modules``: these, and
        ``modules_to_save``, as that table has them. Nothing: the config has to name them."""
        return {}

    def checkpoint_table(self, table: Mapping[str, Any]) -> Mapping[str, Any]:
        """The config's ``model`` as a checkpoint stores it, by default ``table`` itself.

        A model that reads its sizes from a file that a checkpoint does without adds them here.
        """
        return table

    def fsdp_units(self) -> Sequence[Any]:
        """The blocks that are sharded, recomputed and compiled one by one; none by default.

        The model must call each module's ``forward``, because sharded weights are gathered and
        released there. Modules that are used together, such as layer ``i`` of a vision-language
        model and layer ``i`` of the action expert that attends to it (a mixture of transformers),
        are a tuple: they are gathered in one operation before the first of them runs and released
        after the last.
        """
        return []

    # -- an answer in two parts, which is what lets it be captured in a CUDA graph ---------------

    observe: Callable[..., Mapping[str, Any]]
    """The inputs of every denoising step that follow from an observation: name -> tensor.

    A method; its parameters are those of ``predict_action`` that belong to the observation, and
    ``noise`` if more noise follows from it. Everything that does not depend on the noisy actions is
    computed here, once.
    """

    def denoise(self, seen: Mapping[str, Any], noise: Any, tables: Mapping[str, Any]) -> Any:
        """All denoising steps: ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``.

        ``seen`` is the result of ``observe`` and ``tables`` that of ``step_tables``. It only
        launches operations on tensors: nothing is read back to the host, and neither the number
        of steps nor a shape depends on a value.
        """
        raise NotImplementedError(f"{type(self).__name__} has no denoise()")

    def step_tables(self) -> Mapping[str, Any]:
        """Inputs of the denoising steps that follow from the weights alone: name -> tensor.

        For example embeddings of the times of a fixed number of steps. A policy computes them once,
        after its weights have been loaded.
        """
        return {}

    @attribute
    def observe_is_capturable(self) -> bool:
        """Whether ``observe``, too, launches operations on tensors only, as ``denoise`` does."""
        return False

    def exact_modules(self) -> Sequence[Any]:
        """Modules that compute in float32 when the rest computes in bf16, so that their weights
        are kept in float32."""
        return []

    @classmethod
    def _enough(cls, candidate: type) -> tuple[tuple[str, ...], ...]:
        return (("forward",), ("predict_action",))


class Dataset(Contract):
    """Map-style samples; everything random in one follows from (seed, epoch, index).

    A robot's observations are prepared by an ``InferenceDataset`` (``inference.dataset``).
    """

    _besides: ClassVar[Mapping[str, int]] = {"__call__": 1}

    seed: Any = None
    """The seed of its random numbers, an integer; None if unknown."""
    datasets: Sequence[Any] = ()
    """The datasets that a mixture is made of."""

    @abstractmethod
    def __len__(self) -> int:
        """The number of samples."""

    @abstractmethod
    def get_sample(self, index: int, epoch: int) -> Sample:
        """Sample ``index`` as ``epoch`` sees it."""

    # -- optional abilities ----------------------------------------------------------------------

    def get_samples(self, keys: Sequence[Any]) -> list[Sample]:
        """Several samples at once; ``keys`` have ``index`` and ``epoch``."""
        return [self.get_sample(key.index, key.epoch) for key in keys]

    def __getitem__(self, index: int) -> Sample:
        return self.get_sample(index, 0)

    def prepare(self, reporter: Any) -> None:
        """Called once before the first sample, for example to decode data into memory."""

    def use_seed(self, seed: int) -> None:
        """Draw by the run's seed from now on, unless the config gave one."""

    def warnings(self) -> list[str]:
        """Warnings about the data, reported before training begins."""
        return []

    def use_statistics(self, entry: Mapping[str, Any]) -> None:
        """Normalise by these instead of its own: validation data by the training data's."""
        raise NotImplementedError(f"{type(self).__name__} takes no statistics")

    @attribute
    def pipeline(self) -> Any:
        """The ``Pipeline`` of its transforms, whose tokenizers go into checkpoints."""
        return None

    @attribute
    def statistic_name(self) -> str | None:
        """The key of its entry in ``statistics``."""
        return None

    @attribute
    def statistics(self) -> Mapping[str, Any]:
        """``statistic_name`` -> what states and actions are normalised by; for checkpoints."""
        return {}

    @attribute
    def parts(self) -> Mapping[str, int]:
        """Name -> number of samples of each dataset of a mixture, in their order; losses are
        reported by them."""
        return {}

    @attribute
    def embodiment(self) -> EmbodimentSpec | None:
        """The robot that the data are of; goes into checkpoints."""
        return None

    @attribute
    def fps(self) -> float | None:
        """Frames a second: the rate of the actions that are learned."""
        return None

    @attribute
    def action_window_size(self) -> int | None:
        """Actions in a sample's chunk."""
        return None

    @attribute
    def n_obs_steps(self) -> int:
        """Observations of a sample, as ``VLA.n_obs_steps`` says."""
        return 1

    @attribute
    def past_actions(self) -> int:
        """Actions of a sample's chunk before the present one's, as ``VLA.past_actions`` says."""
        return 0

    @attribute
    def tasks(self) -> Sequence[str]:
        """The instructions in the data."""
        return ()

    @attribute
    def episode_ends(self) -> npt.NDArray[np.int64] | None:
        """``(episodes,)`` index behind each episode's last sample, for ``shuffle_episodes``."""
        return None

    @classmethod
    def _enough(cls, candidate: type) -> tuple[tuple[str, ...], ...]:
        return (("__len__", "get_sample"), ("__len__", "get_samples"), ("__call__",))


class InferenceDataset(Contract):
    """Prepares a robot's observations: the arguments of a model's ``predict_action``."""

    pipeline: Any = None
    """The ``Pipeline`` of its transforms, whose normalisation of actions is inverted."""
    statistic_name: str = "private"
    """Which entry of the training's statistics is used."""

    @abstractmethod
    def __call__(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """A batch of one observation."""


class _AnyTransform(Contract):
    """Common base of ``Transform`` and ``RandomTransform``, whose calls differ."""

    needs_rng: ClassVar[bool] = False
    """Whether ``__call__`` takes a random number generator, too."""
    training_only: ClassVar[bool] = False
    """Whether a robot's observations do not pass it: augmentation, noise."""
    keeps_images: ClassVar[bool] = False
    """Whether its ``__call__`` neither reads nor changes images. Subclasses with another
    ``__call__`` say so again."""
    tokenizer: Any = None
    """The tokenizer that it uses; goes into checkpoints."""

    def warnings(
        self, stats: Mapping[str, Any], states: Sequence[str], actions: Sequence[str]
    ) -> list[str]:
        """Warnings about the statistics; ``states`` and ``actions`` are their names."""
        return []

    def denormalizer(self, norm_stats: Mapping[str, Any], statistic_name: str) -> Any:
        """The inverse transform, for actions."""
        raise NotImplementedError(f"{type(self).__name__} normalises no actions")

    def defer(self, sample: Sample) -> Sample:
        """As ``__call__``, but images are left for normalisation on the device."""
        raise NotImplementedError(f"{type(self).__name__} normalises no images")


class Transform(_AnyTransform):
    """Sample in, sample out; never changes the arrays that it was given."""

    @abstractmethod
    def __call__(self, sample: Sample) -> Sample:
        """The changed sample."""


class RandomTransform(_AnyTransform):
    """A transform that draws random numbers, from the generator that it is given."""

    needs_rng: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        """The changed sample."""


class Collator(Contract):
    """Makes a batch of samples."""

    @abstractmethod
    def __call__(self, samples: Sequence[Sample]) -> Mapping[str, Any]:
        """The batch, whose keys are the model's arguments."""


class Tokenizer(Contract):
    """Turns text into numbers."""

    padding_side: str = "right"
    pad_token_id: int | None = None
    model_path: str | None = None
    """The path or name that it was loaded from, as in a config."""
    base_vocab_size: int | None = None
    """Number of ids without added tokens; a model that embeds fewer is refused. None if unknown."""

    @abstractmethod
    def encode(self, text: str) -> Sequence[int]:
        """Token ids."""

    def save_pretrained(self, folder: Any) -> Any:
        """Write the files to load it from; goes into checkpoints."""

    def encode_actions(self, actions: Any) -> Sequence[int]:
        """Token ids of a chunk of normalised actions ``(T, D)``."""
        raise NotImplementedError(f"{type(self).__name__} is no tokenizer of actions")


class Metric(Contract):
    """Records the numbers of a training and passes them to trackers; called on rank 0 only."""

    @abstractmethod
    def start(self, step: int, config: Mapping[str, Any]) -> None:
        """Training begins, or continues, after ``step``."""

    @abstractmethod
    def commit(self, *, global_step: int, epoch: int, loss: float, lr: float, **more: Any) -> None:
        """The numbers of one optimizer step."""

    @abstractmethod
    def push(self) -> Any:
        """Pass on the numbers committed since the last call."""

    @abstractmethod
    def sync(self) -> None:
        """Make everything that was pushed durable; called before each checkpoint."""

    @abstractmethod
    def state_dict(self) -> Mapping[str, Any]:
        """JSON values that go into a checkpoint."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a checkpoint."""

    @abstractmethod
    def finalize(self) -> None:
        """Training has ended."""


class Optimizer(Contract):
    """An optimizer's settings."""

    @abstractmethod
    def build(self, groups: list[dict[str, Any]], learning_rate: float) -> Any:
        """The ``torch.optim.Optimizer`` of the parameter ``groups``."""
