"""``GymnasiumEnvironment``: one Gymnasium id behind the core's contract.

Gymnasium says what shape numbers have, and not what they mean. The config does, with an embodiment:
a policy that means something else by its numbers is refused before the first step.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
from fluxvla_mujoco import MujocoEnvironment, check_render, note_renderer, set_render, use_egl

from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed, SpecMismatch
from fluxvla_core.evaluation import EnvironmentSpec, Step, TaskSpec
from fluxvla_core.operators import Camera, EmbodimentSpec
from fluxvla_gymnasium.parts import images_of, parts, state_row, text

if TYPE_CHECKING:
    from fluxvla_core.models import Observation

Array = npt.NDArray[np.float64]
KEYS = ("is_success", "success")
SUCCESS = ("info", "terminated", "truncated")


@dataclass(frozen=True)
class SuccessCriterion:
    """When a task is done: Gymnasium itself does not define it.

    Args:
        by: ``info``: by its ``is_success`` or ``success``; ``terminated``: by the end;
            ``truncated``: by lasting until the time is up.
        reward: instead: by a step's reward of at least this.
        total: instead: by a return, the sum of rewards, of at least this.

    Raises:
        ConfigError: there is no such way, or there are two.
    """

    by: str = "info"
    reward: float | None = None
    total: float | None = None

    def __post_init__(self) -> None:
        if self.by not in SUCCESS:
            raise ConfigError(f"success {self.by!r} is not one of {', '.join(SUCCESS)}")
        if self.reward is not None and self.total is not None:
            raise ConfigError("success_reward and success_return are two ways: give one of them")

    @property
    def needs_info(self) -> bool:
        """Whether ``info`` must say it."""
        return self.by == "info" and self.reward is None and self.total is None

    def done(
        self, reward: float, total: float, terminated: bool, lasted: bool, info: Mapping[str, Any]
    ) -> bool:
        """Whether the task was done by a step.

        Args:
            total: rewards so far, this one included.
            lasted: the time was up with this step.
        """
        if self.reward is not None:
            return reward >= self.reward
        if self.total is not None:
            return total >= self.total
        if self.by == "terminated":
            return terminated
        if self.by == "truncated":
            return lasted and not terminated
        return any(bool(info[key]) for key in KEYS if key in info)


def reports_success(info: Mapping[str, Any]) -> bool:
    """Whether ``info`` says if the task is done."""
    return any(key in info for key in KEYS)


class GymnasiumEnvironment(MujocoEnvironment):
    """One Gymnasium environment as one task.

    An episode ends when Gymnasium says so, or with success. Its seed is given to Gymnasium's reset
    and to the action space, from which some environments draw.

    Args:
        id: Gymnasium's, for example ``gym_aloha/AlohaTransferCube-v0``.
        embodiment: what its numbers mean: a table as ``EmbodimentSpec.from_dict`` takes it. Joints
            are the action's numbers in their order, ``state_joints`` the state's.
        module: an installed package that registers the id when it is imported, ``gym_aloha``.
        make: further arguments of ``gymnasium.make``.
        instruction: the language instruction; the id by default.
        instruction_from: instead: a text of the observation, which may be another in each episode.
        max_steps: steps after which an episode ends at the latest.
        state: parts of the observation that are the state, in this order, keys of nested parts
            joined by dots; by default every part that is neither an image nor text, by name.
        cameras: camera of the embodiment -> part of the observation, or ``render`` for what
            Gymnasium's ``render()`` gives; by default the part of that name.
        success: ``info`` (its ``is_success`` or ``success``), ``terminated``, or ``truncated``:
            it lasted until the time was up, as a pole that did not fall.
        success_reward: instead: a step's reward from which on the task is done.
        success_return: instead: a return, the sum of an episode's rewards, from which on it is.
        render: ``cheap`` images (no shadows, no multisampling) where the simulator is MuJoCo, or
            the environment's own: ``reference``.

    Raises:
        ConfigError: a value is impossible.
        SpecMismatch: the embodiment is none.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        id: str,
        embodiment: Mapping[str, Any] | EmbodimentSpec,
        module: str | None = None,
        make: Mapping[str, Any] | None = None,
        instruction: str | None = None,
        instruction_from: str | None = None,
        max_steps: int = 1000,
        state: Sequence[str] | None = None,
        cameras: Mapping[str, str] | None = None,
        success: str = "info",
        success_reward: float | None = None,
        success_return: float | None = None,
        render: str = "cheap",
    ) -> None:
        check_render(render)
        if ":" in id:
            name, _, rest = id.partition(":")
            raise ConfigError(
                f"id {id!r} names a module",
                next=f"--set <GymnasiumEnvironment>.module={name} "
                f"--set <GymnasiumEnvironment>.id={rest}",
            )
        if module is not None and not module.isidentifier():
            raise ConfigError(f"module {module!r} is not the name of an installed package")
        self._criterion = SuccessCriterion(success, success_reward, success_return)
        if instruction is not None and instruction_from is not None:
            raise ConfigError("instruction and instruction_from are two ways: give one of them")
        if max_steps < 1:
            raise ConfigError(f"max_steps must be at least 1, got {max_steps}")
        if not isinstance(embodiment, EmbodimentSpec):
            embodiment = EmbodimentSpec.from_dict({"cameras": (), **embodiment})
        unknown = sorted(set(cameras or {}) - set(embodiment.camera_names))
        if unknown:
            raise ConfigError(
                f"cameras: the embodiment has no camera {unknown[0]!r}; "
                f"it has {', '.join(embodiment.camera_names) or 'none'}"
            )
        name = re.sub(r"[^\w.-]+", "-", id)
        self.spec = EnvironmentSpec(
            name=id,
            embodiment=embodiment,
            tasks=(TaskSpec(name, instruction or id, max_steps),),
            details={"render": render},
        )
        self.distributions = ("gymnasium", "mujoco", *([] if module is None else [module]))
        self._module = module
        self._make = dict(make or {})
        self._keys = state
        self._cameras = {**{n: n for n in embodiment.camera_names}, **(cameras or {})}
        if "render" in self._cameras.values():
            self._make.setdefault("render_mode", "rgb_array")
        self._instruction_from = instruction_from
        self._max_steps = max_steps
        self._steps, self._return = 0, 0.0
        self._render = render
        self._env: Any = None
        self._parts: dict[str, npt.NDArray[Any]] = {}
        self._done = self._checked = False

    @property
    def state(self) -> Array:
        """``(state_dim,)``: the observation's numbers in one row."""
        return state_row(self._parts, self._keys)

    @property
    def simulation(self) -> Any:
        """``mujoco.MjData`` where there is one: Gymnasium's MuJoCo environments have it, and
        dm_control's physics."""
        inner = self._env.unwrapped
        physics = getattr(getattr(inner, "_env", None), "physics", None)
        found = (getattr(inner, "data", None), getattr(physics, "data", None))
        data = [getattr(each, "ptr", each) for each in found]
        return next((each for each in data if hasattr(each, "warning")), None)

    def reset(self, seed: int, task: str) -> None:
        """Begin an episode.

        Raises:
            MissingPlugin: no installed package has this id.
            ConfigError: the environment does not say whether its task is done.
            SpecMismatch: the action or the state has not as many numbers as the embodiment.
            RunFailed: the environment cannot be made.
        """
        if self._env is None:
            self._env = self._made()
        self._env.action_space.seed(seed)
        seen, _ = self._env.reset(seed=seed)
        self._parts, self._done = parts(seen), False
        self._steps, self._return = 0, 0.0
        if len(self.state) != self.spec.embodiment.state_dim:
            raise SpecMismatch(
                f"the state of {self.spec.name} has {len(self.state)} numbers, "
                f"the embodiment {self.spec.embodiment.state_dim}",
                cause=f"the observation's parts are {_shapes(self._parts)}",
                next="fix state_joints, or name the parts that are the state: state = ['...']",
            )
        if self._criterion.needs_info and not self._checked:
            _check_reports_success(self._env, self._max_steps)
            self._checked = True
            self.reset(seed, task)

    def step(self, action: Array) -> Step:
        """One step; values beyond the action space's limits are the environment's affair."""
        from gymnasium.spaces import Discrete

        space = self._env.action_space
        if isinstance(space, Discrete):
            given: Any = int(np.clip(np.rint(action[0]), space.start, space.start + space.n - 1))
        else:
            given = np.asarray(action, space.dtype).reshape(space.shape)
        seen, reward, terminated, truncated, info = self._env.step(given)
        self._parts = parts(seen)
        reward, terminated = float(reward), bool(terminated)
        self._steps += 1
        self._return += reward
        lasted = bool(truncated) or self._steps >= self._max_steps
        self._done |= self._criterion.done(reward, self._return, terminated, lasted, info)
        return Step(reward, self._done, terminated or bool(truncated) or self._done)

    def observe(self, cameras: Sequence[Camera]) -> Observation:
        """State and images; these are of the environment's sizes.

        Raises:
            SpecMismatch: there is no such image.
        """
        return {
            "qpos": self.state.astype(np.float32),
            "images": {camera.name: self._image(camera.name) for camera in cameras},
            "task_description": self._instruction(),
        }

    def close(self) -> None:
        """Give everything back; any number of times."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _instruction(self) -> str:
        if self._instruction_from is None:
            return self.spec.tasks[0].instruction
        return text(self._parts, self._instruction_from)

    def _image(self, camera: str) -> npt.NDArray[np.uint8]:
        key = self._cameras.get(camera, camera)
        if key == "render":
            drawn = np.array(self._env.render(), dtype=np.uint8)
            note_renderer()
            return drawn
        found = images_of(self._parts)
        ends = [name for name in found if name == key or name.endswith(f".{key}")]
        if len(ends) != 1:
            raise SpecMismatch(
                f"{self.spec.name} has no image {key!r}; it has {', '.join(found) or 'none'}",
                next=f"--set '<GymnasiumEnvironment>.cameras={{{camera} = \"NAME\"}}', "
                "one of these or render",
            )
        return found[ends[0]].copy()

    def _made(self) -> Any:
        use_egl()
        import gymnasium
        from gymnasium.error import UnregisteredEnv
        from gymnasium.spaces import Box, Discrete

        where = f"gymnasium.make({self.spec.name!r})"
        if self._module is not None:
            try:
                importlib.import_module(self._module)
            except ImportError as error:
                raise MissingPlugin(
                    f"module {self._module!r} cannot be imported: {error}",
                    next="install the package that has the environment",
                ) from error
        try:
            env = gymnasium.make(self.spec.name, **self._make)
        except UnregisteredEnv as error:
            raise MissingPlugin(
                f"there is no Gymnasium environment {self.spec.name!r}: {error}",
                cause="its package is not installed, or registers it only when it is imported",
                next="install it, and --set <GymnasiumEnvironment>.module=<the package>",
            ) from error
        except Exception as error:
            raise RunFailed(
                f"the environment cannot be made: {type(error).__name__}: {error}", where=where
            ) from error
        space = env.action_space
        if not isinstance(space, (Box, Discrete)):
            raise SpecMismatch(f"{where}: actions in {space} are not a vector", where=where)
        numbers = 1 if isinstance(space, Discrete) else int(np.prod(space.shape))
        if numbers != self.spec.embodiment.dim:
            raise SpecMismatch(
                f"actions of {self.spec.name} have {numbers} numbers, "
                f"the embodiment has {self.spec.embodiment.dim} joints"
            )
        for model in _mujoco_models(env):
            set_render(model, self._render)
        return env


def _check_reports_success(env: Any, max_steps: int) -> None:
    """Refuse an environment whose ``info`` never says whether the task is done: by one step as a
    rule, by a whole episode of random actions where it might say so only at the end.

    Raises:
        ConfigError: with what to set instead.
    """
    env.reset(seed=0)
    env.action_space.seed(0)
    info: Mapping[str, Any] = {}
    for _ in range(max_steps):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        if reports_success(info):
            return
        if terminated or truncated:
            break
    raise ConfigError(
        f"{env.spec.id} does not say whether its task is done: its info has "
        f"{', '.join(sorted(map(str, info))) or 'nothing'}, and neither of {', '.join(KEYS)}",
        next="--set <GymnasiumEnvironment>.success=terminated (or truncated), "
        "--set <GymnasiumEnvironment>.success_reward=<a step's reward when it is done>, or "
        "--set <GymnasiumEnvironment>.success_return=<an episode's>",
    )


def _mujoco_models(env: Any) -> list[Any]:
    """``MjModel`` of Gymnasium's MuJoCo environments and of those around dm_control."""
    inner = env.unwrapped
    physics = getattr(getattr(inner, "_env", None), "physics", None)
    found = [getattr(inner, "model", None), getattr(getattr(physics, "model", None), "ptr", None)]
    return [model for model in found if hasattr(getattr(model, "vis", None), "quality")]


def _shapes(found: Mapping[str, npt.NDArray[Any]]) -> str:
    return ", ".join(f"{name or 'the whole'} {array.shape}" for name, array in found.items())
