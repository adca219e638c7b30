"""``LocalPolicy``: a model in this process as a policy, with pre- and postprocessing."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Continuation, Policy
from fluxvla_core.contracts.training import VLA
from fluxvla_core.errors import ConfigError, DataError, quoted
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.training.input_sizes import largest_token

if TYPE_CHECKING:
    from fluxvla_core.policies.execution import Transfer

Array = npt.NDArray[np.float64]
# float32 statistics and the sizes that joints have: far above rounding, far below a mistake.
_CLOSE = 1e-4
PRECISIONS = ("float32", "bf16")


@dataclass(frozen=True)
class Query:
    """A query of an episode: observation, seed, number of earlier queries, and the rest of the
    last chunk, which the answer has to continue."""

    observation: Observation
    seed: int
    call: int
    rest: Continuation | None = None


class LocalPolicy(Policy):
    """A model in this process as the Policy contract has it; ``load_policy`` makes one.

    The noise of call ``n`` of an episode follows from (seed, n) alone, so that an episode can be
    repeated. ``stages`` holds the seconds that the last call took: ``preprocess``,
    ``inference``, ``postprocess``; ``parts`` those of inference, on the device: ``transfer`` of the
    batch, then ``forward``, or ``prefix`` and ``denoise`` of a model that divides its answer
    (``VLA.observe``). Every forward pass has ``batch_size`` rows (1 unless it is
    set), however many queries there are: kernels, and so sums, depend on the size.

    Args:
        model: ``predict_action(**batch) -> (B, T, D)``, in evaluation mode.
        prepare: observation -> batch of one.
        denormalize: ``{"action": (1, T, D), "states": (S,)}`` -> ``(T, dim)`` physical units.
        embodiment: the robot that it was trained for.
        cameras: names of the images that ``prepare`` looks at.
        action_rate_hz, horizon: rate and length of the model's chunks; a model's ``past_actions``
            are left out of the policy's, whose ``horizon`` is shorter by them.
        device: the torch device of the model.
        precision: ``float32`` or ``bf16`` (autocast).
        source: where it came from, for records.
        execution: ``eager``, ``compiled`` or ``graph``: see ``policies.execution``.
        vocabulary: tokens that the model embeds; an instruction with another one is refused. None
            if unknown.

    Raises:
        ConfigError: a precision or an execution is unknown, or not available here.

    A model's ``n_obs_steps`` is the policy's: with more than one, what it is asked with has to have
    a ``history``, whose observations are prepared one by one as the present one is.
    """

    embodiment: EmbodimentSpec
    cameras: tuple[str, ...]
    action_rate_hz: float
    horizon: int
    n_obs_steps: int
    source: str
    stages: dict[str, float]
    parts: dict[str, float]

    def __init__(
        self,
        model: Any,
        prepare: Callable[[Mapping[str, Any]], dict[str, Any]],
        denormalize: Callable[[Mapping[str, Any]], Array],
        embodiment: EmbodimentSpec,
        cameras: tuple[str, ...],
        action_rate_hz: float,
        horizon: int,
        device: str = "cpu",
        precision: str = "float32",
        source: str = "",
        execution: str = "eager",
        vocabulary: int | None = None,
    ) -> None:
        if precision not in PRECISIONS:
            raise ConfigError(
                f"mixed_precision_dtype {precision!r} is unknown; choose one of "
                f"{', '.join(PRECISIONS)}"
            )
        self.embodiment = embodiment
        self.cameras = cameras
        self.action_rate_hz = action_rate_hz
        described = VLA.adapt(model)
        self.n_obs_steps, self._past = described.n_obs_steps, described.past_actions
        self.horizon = horizon - self._past
        self.source = source
        self.batch_size = 1
        self.stages, self.parts = {}, {}
        self._prepare = prepare
        self._denormalize = denormalize
        self._vocabulary = vocabulary
        self.device = device
        self.precision = precision
        self._seed = 0
        self._calls = 0
        self._transfer: Transfer | None = None
        self._compiled: Any = None
        self.execution = execution
        self.model = model

    @property
    def model(self) -> Any:
        """The model that answers; one that is set is run as ``execution`` says."""
        return self._model

    @model.setter
    def model(self, model: Any) -> None:
        self._model = model
        taken = inspect.signature(model.predict_action).parameters
        self._takes_all = any(p.kind is p.VAR_KEYWORD for p in taken.values())
        self._takes = set(taken)
        self.execute(self.execution)

    def execute(self, execution: str) -> None:
        """Answer as ``execution`` says from now on; a model whose blocks are compiled stays so.

        Raises:
            ConfigError: it is unknown, or not available for this model or on this machine.
        """
        from fluxvla_core.policies.execution import execution_of

        compiled = self._compiled is self._model
        self._execution = execution_of(execution, self._model, compiled)
        self.execution = execution
        if execution != "eager":
            self._compiled = self._model

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._seed, self._calls = seed, 0

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, dim)`` float64 in physical units; key ``j`` is for ``(j + 1) / rate``.

        Raises:
            DataError, ConfigError: the observation lacks something that the transforms need.
        """
        return self._predict(observation)

    @property
    def continues(self) -> bool:
        """Whether its model takes the rest of a chunk, and what it makes can be scaled back."""
        if "prev_actions" not in self._takes or self._past:
            return False
        zeros = np.zeros(self.embodiment.state_dim)
        return scaling_of(self._denormalize, self.model.action_shape, zeros) is not None

    def continue_action(self, observation: Observation, rest: Continuation) -> Array:
        """As ``predict_action``, for a chunk that continues ``rest``.

        The model gets ``prev_actions`` ``(1, T, D)`` normalised, ``prefix_weights`` ``(1, T)``,
        ``prefix_len`` ``(1,)`` and ``max_guidance_weight`` ``(1,)``.

        Raises:
            ConfigError: the model takes no such thing, or its actions cannot be scaled back.
            DataError: the observation lacks something that the transforms need.
        """
        return self._predict(observation, rest)

    def host_batch(self, queries: Sequence[Query]) -> dict[str, Any]:
        """The model's input for ``queries``, in ``batch_size`` rows, still on the host."""
        import torch

        rows = [self._row(query) for query in queries]
        rows += rows[:1] * (self.batch_size - len(rows))
        return {
            key: torch.cat([row[key] for row in rows])
            if isinstance(value, torch.Tensor)
            else [item for row in rows for item in row[key]]
            for key, value in rows[0].items()
        }

    def predict_batch(self, queries: Sequence[Query]) -> list[Array]:
        """An answer to each of at most ``batch_size`` queries, in one forward pass.

        Either all of them continue a chunk, or none does.

        Raises:
            DataError, ConfigError: an observation lacks something that the transforms need.
        """
        import torch

        from fluxvla_core.policies.execution import clock_of

        if not 1 <= len(queries) <= self.batch_size:
            raise ValueError(f"{len(queries)} queries, and batch_size is {self.batch_size}")
        start = time.perf_counter()
        host = self.host_batch(queries)
        prepared = time.perf_counter()
        transfer, clock = self._transfers(), clock_of(self.device)
        mixed = torch.autocast(
            transfer.device.type,
            torch.bfloat16,
            enabled=self.precision == "bf16",
            cache_enabled=self._execution.caches_casts,
        )
        # A model that is guided differentiates, which tensors of inference_mode do not allow.
        mode = torch.no_grad() if "prev_actions" in host else torch.inference_mode()
        with mode, mixed:
            batch = transfer.to_device(host)
            clock.mark("transfer")
            actions = transfer.fetch(self._execution.answer(batch, clock))
        inferred = time.perf_counter()
        chunks = [
            self._denormalize(
                {
                    "action": actions[place : place + 1],
                    "states": np.asarray(query.observation["qpos"]),
                }
            )[self._past :]
            for place, query in enumerate(queries)
        ]
        self.stages = {
            "preprocess": prepared - start,
            "inference": inferred - prepared,
            "postprocess": time.perf_counter() - inferred,
        }
        self.parts = clock.seconds()
        return chunks

    def _transfers(self) -> Transfer:
        from fluxvla_core.policies.execution import Transfer

        if self._transfer is None or str(self._transfer.device) != self.device:
            self._transfer = Transfer(self.device)
        return self._transfer

    def _predict(self, observation: Observation, rest: Continuation | None = None) -> Array:
        chunk = self.predict_batch([Query(observation, self._seed, self._calls, rest)])[0]
        self._calls += 1
        return chunk

    def _row(self, query: Query) -> dict[str, Any]:
        """A batch of one, with what the model takes."""
        import torch

        row = self._prepared(query.observation)
        if "noise" in self._takes:
            row["noise"] = torch.from_numpy(self._noise(query.seed, query.call))
        if query.rest is not None:
            row |= self._rest(query.rest, query.observation)
        if not self._takes_all:
            row = {key: value for key, value in row.items() if key in self._takes}
        return row

    def _prepared(self, observation: Observation) -> dict[str, Any]:
        """A batch of one; of several observations, with their images and states stacked.

        Raises:
            ConfigError: the observation has not the history that the model needs, or a token that
                the model does not embed.
        """
        import torch

        history = tuple(observation.get("history", ()))
        if len(history) != self.n_obs_steps - 1:
            raise ConfigError(
                f"the policy of {self.source or 'this model'} acts on {self.n_obs_steps} "
                f"observations (n_obs_steps), it was asked with {1 + len(history)}",
                cause="what asks it keeps no earlier observations"
                if not history
                else "they were kept for another policy",
                next="observation['history'] has the n_obs_steps - 1 before, the oldest first",
            )
        rows = [self._prepare(self._sized(seen)) for seen in (*history, observation)]
        present: dict[str, Any] = rows[-1]
        if self._vocabulary is not None and (token := largest_token(present)) >= self._vocabulary:
            said = observation.get("task_description", "")
            raise ConfigError(
                f"the instruction {quoted(str(said))} has the token {token}; the policy of "
                f"{self.source or 'this model'} knows those below {self._vocabulary}",
                cause="the tokenizer is not the model's, or has added tokens that the model lacks",
                next="use other words, or name the model's own tokenizer",
            )
        several = [key for key in ("images", "states") if history and key in present]
        for key in several:
            present[key] = torch.stack([row[key] for row in rows], dim=1)
        return present

    def _rest(self, rest: Continuation, observation: Observation) -> dict[str, Any]:
        """The rest of a chunk as the model takes it, a batch of one."""
        import torch

        states = np.asarray(observation["qpos"], dtype=np.float64)
        scaling = scaling_of(self._denormalize, self.model.action_shape, states)
        if "prev_actions" not in self._takes or scaling is None:
            raise ConfigError(
                f"the policy of {self.source or 'this model'} cannot continue a chunk"
            )
        actions = scaling.normalized(rest.actions)
        return {
            "prev_actions": torch.from_numpy(actions.astype(np.float32))[None],
            "prefix_weights": torch.from_numpy(rest.weights.astype(np.float32))[None],
            "prefix_len": torch.tensor([rest.frozen]),
            "max_guidance_weight": torch.tensor([rest.max_guidance_weight], dtype=torch.float32),
        }

    def _sized(self, observation: Observation) -> dict[str, Any]:
        """The observation with images of the size that the policy was trained on.

        The transforms may cut pixels by number. A camera with more pixels of the same view is
        scaled down. ``run_setup`` has refused a robot whose cameras have another view; whoever
        calls the policy directly learns of it here.

        Raises:
            DataError: an image of another aspect, beyond a hundredth.
        """
        images = dict(observation["images"])
        for camera in self.embodiment.cameras:
            image = images.get(camera.name)
            if image is None or not image.size:  # refused where images are read
                continue
            if image.shape[:2] != (camera.height, camera.width):
                import cv2

                rows, columns = image.shape[:2]
                apart = abs(columns * camera.height - camera.width * rows)
                if camera.name in self.cameras and apart > 0.01 * rows * camera.width:
                    raise DataError(
                        f"camera {camera.name!r} gives {rows} x {columns} images; the policy was "
                        f"trained on {camera.height} x {camera.width}: another view",
                        next="set the camera to the size, or the aspect, of the recordings",
                    )
                size = (camera.width, camera.height)
                images[camera.name] = np.asarray(
                    cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8
                )
        return {**observation, "images": images}

    def _noise(self, seed: int, call: int) -> npt.NDArray[np.float32]:
        # A key of its own for each call; counter-based, so that calls share no numbers.
        key = np.array([seed, call], dtype=np.uint64)
        generator = np.random.Generator(np.random.Philox(key=key))
        shape = (1, *self.model.action_shape)
        return generator.standard_normal(shape, dtype=np.float32)


@dataclass(frozen=True)
class Scaling:
    """Element-wise offset and slope between a model's normalised actions and physical ones.

    ``physical = offset + slope * normalized``, both ``(T, D)``; the model's rows are wider.

    A checkpoint, or a config, has the function from a model's actions to a robot's
    (``denormalize_action``), which may depend on the state. Its inverse is found by probing: an
    invertible one scales and shifts element by element, so that two of its values determine it.
    """

    offset: Array
    slope: Array
    width: int

    def normalized(self, actions: Array) -> Array:
        """``(T, D)`` physical -> ``(T, width)``; 0 where nothing depends on the model's value."""
        fixed = self.slope == 0.0
        values = np.where(fixed, 0.0, (actions - self.offset) / np.where(fixed, 1.0, self.slope))
        return np.pad(values, ((0, 0), (0, self.width - values.shape[1])))


def scaling_of(
    denormalize: Callable[[Mapping[str, Any]], Array], shape: tuple[int, int], states: Array
) -> Scaling | None:
    """The scaling by ``denormalize`` of a chunk of ``shape`` ``(T, width)`` in ``states`` ``(S,)``.

    None if it does not scale and shift element by element: it rounds, clips or mixes.
    """
    rng = np.random.default_rng(0)
    probe = rng.uniform(-1.0, 1.0, shape)
    zeros, ones, found = (
        denormalize({"action": rows[None].astype(np.float32), "states": states})
        for rows in (np.zeros(shape), np.ones(shape), probe)
    )
    scaling = Scaling(zeros, ones - zeros, shape[1])
    expected = zeros + scaling.slope * probe[:, : zeros.shape[1]]
    size = np.abs(zeros).max() + np.abs(ones).max() + 1e-12
    return scaling if np.allclose(found, expected, rtol=0.0, atol=_CLOSE * size) else None
