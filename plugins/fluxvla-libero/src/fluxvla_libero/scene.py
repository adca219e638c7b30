"""Scene of one LIBERO task: reset, step, render.

LIBERO builds the whole model again for every episode (2 to 3 seconds). Here that happens once for a
scene; afterwards everything that an episode could leave behind is put back, which takes a
hundredth of the time. A test holds both against each other, bit for bit.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from fluxvla_mujoco import Drawing, check_render

from fluxvla_core.errors import RunFailed
from fluxvla_libero.embodiment import ACTION_DIM, CONTROL_HZ, NO_OP, axis_angle
from fluxvla_libero.require import quiet, require_libero
from fluxvla_libero.suites import SuiteTask, goal

Array = npt.NDArray[np.float64]

ENV_SEED = 0
"""What the simulator's random numbers start from. They place what cannot move (cabinets, stoves),
also where the fixed states place everything else. When they start is a matter of the protocol, see
:class:`~fluxvla_libero.environment.LiberoEnvironment`."""

_MAX_TRIES = 20

SHOWN_GROUPS = {0: 0, 1: 1}
"""As robosuite shows a scene: visual shapes (group 1), no collision shapes (group 0)."""


class LiberoScene:
    """The simulation of one task.

    Args:
        task: the task.
        render: how images are drawn, see ``fluxvla_mujoco.drawing``.

    Raises:
        MissingPlugin, RunFailed: see ``require_libero``.
    """

    def __init__(self, task: SuiteTask, render: str = "cheap") -> None:
        check_render(render)
        self.task = task
        self.steps = 0
        self._render = render
        self._env = _build(task)
        self._sim = self._env.sim
        self._drawing: Drawing | None = None
        self._observed: Any = None
        model = self._sim.model._model
        self._shown = _follow(self._env)
        self._samplers = list(self._env.object_property_initializers)
        self._fixed = {name: getattr(model, name).copy() for name in _CHANGED_BY_EPISODES}

    @property
    def model(self) -> Any:
        """``mujoco.MjModel``."""
        return self._sim.model._model

    @property
    def data(self) -> Any:
        """``mujoco.MjData``."""
        return self._sim.data._data

    @property
    def state(self) -> Array:
        """``(8,)``: gripper position (m), axis times angle (rad), both fingers (m)."""
        seen = self._observed
        return np.concatenate(
            [
                seen["robot0_eef_pos"],
                axis_angle(seen["robot0_eef_quat"]),
                seen["robot0_gripper_qpos"],
            ]
        )

    @property
    def quaternion(self) -> Array:
        """The gripper's orientation in the world, x, y, z, w."""
        return np.array(self._observed["robot0_eef_quat"])

    @functools.cached_property
    def _built(self) -> dict[str, Array]:
        """Positions from the model's file, before anything was placed: there each of
        LIBERO's own resets begins, because it builds the model again."""
        with quiet():
            from robosuite.utils.binding_utils import MjSim

            model = MjSim.from_xml_string(self._env.model.get_xml()).model._model
        places = {name: getattr(model, name).copy() for name in ("body_pos", "body_quat")}
        return {**self._fixed, **places}  # colours as they are once its marks are hidden

    def reset(self, init_state: Array | None = None, seed: int = ENV_SEED, resets: int = 1) -> None:
        """Begin an episode; nothing of the ones before is left.

        Args:
            init_state: ``(1 + nq + nv,)``, one of the suite's fixed states; without one everything
                is placed at random within the task's regions.
            seed: of what is placed at random.
            resets: how often LIBERO's environment would have been reset since it was seeded, this
                time included: each reset draws on, and places what cannot move elsewhere.

        Raises:
            RunFailed: the simulator finds no room for the objects, or the state does not fit.
        """
        env = self._env
        np.random.seed(seed)
        if init_state is None:
            self._place_again(self._fixed, seed)
        else:
            loads = 1
            for _ in range(resets):
                loads += self._place_again(self._built, seed, loads)
        self._sim.forward()
        env._obs_cache = {}
        if init_state is not None:
            self._set_state(init_state)
        self._observed = env._get_observations(force_update=True)
        self.steps = 0

    def settle(self, steps: int) -> None:
        """Hold still, gripper open, for ``steps`` control steps that do not count."""
        for _ in range(steps):
            self.step(NO_OP)
        self.steps = 0

    def step(self, action: Array) -> None:
        """One control step (1/20 s) with an action ``(7,)``; values beyond 1 are cut by LIBERO.

        Raises:
            RunFailed: another shape, or not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (ACTION_DIM,) or not np.isfinite(action).all():
            raise RunFailed(f"LIBERO takes 7 finite numbers, got {action.tolist()}")
        self._observed = self._env.step(action)[0]
        self.steps += 1

    def done(self, task: SuiteTask | None = None) -> bool:
        """Whether the goal of ``task`` (this scene's by default) holds now."""
        return all(self._env._eval_predicate(state) for state in goal(task or self.task))

    def can_check(self, task: SuiteTask) -> bool:
        """Whether everything that ``task``'s goal speaks of is in this scene."""
        there = self._env.object_states_dict
        return all(name in there for state in goal(task) for name in state[1:])

    def render(self, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """``(height, width, 3)`` uint8 RGB of a camera of the scene, as the public datasets show
        it: robosuite's images, which are upside down, turned by 180 degrees. That is upright,
        with left and right exchanged."""
        if self._drawing is None:
            self._drawing = Drawing(self.model, self._render, SHOWN_GROUPS)
        upright = self._drawing.image(self._shown, camera, height, width)
        return np.ascontiguousarray(upright[:, ::-1])

    def state_hash(self) -> str:
        """Hash of positions and velocities; equal for equal episodes."""
        data = self.data
        return hashlib.sha256(data.qpos.tobytes() + data.qvel.tobytes()).hexdigest()[:16]

    def close(self) -> None:
        """Free the images' contexts and the simulator; any number of times."""
        if self._drawing is not None:
            self._drawing.close()
            self._drawing = None
        if self._env is not None:
            with quiet():
                self._env.close()
            self._env = None

    def _place_again(self, model: Mapping[str, Array], seed: int, loads: int = 0) -> int:
        """Place everything, from what the model says; how many tries that took.

        Args:
            loads: how often LIBERO would have loaded the model before. Each time it adds another
                set of samplers for what is open or turned on, and all of them draw.
        """
        for tries in range(1, _MAX_TRIES + 1):
            self._put(model)
            copies = loads + tries if loads else 1
            self._env.object_property_initializers = self._samplers * copies
            if self._place():
                return tries
        raise RunFailed(
            f"{self.task.name}: no room for all objects in {_MAX_TRIES} tries", where=str(seed)
        )

    def _put(self, values: Mapping[str, Array]) -> None:
        for name, value in values.items():
            getattr(self.model, name)[:] = value

    def _place(self) -> bool:
        """robosuite's soft reset, without what it forgets; False if there was no room."""
        from robosuite.utils.errors import RandomizationError

        env = self._env
        # The controller is made from where the arm's base is, which a reset alone does not say.
        self._sim.reset()
        self._sim.forward()
        # LIBERO's image context does so once more, and the solver starts from what it found.
        self._sim.forward()
        for robot in env.robots:
            # The fingers' target, which is summed up from one command to the next.
            robot.gripper.current_action = np.zeros_like(robot.gripper.current_action)
        try:
            env._reset_internal()
        except RandomizationError:
            return False
        return True

    def _set_state(self, init_state: Array) -> None:
        expected = 1 + self.model.nq + self.model.nv
        if init_state.shape != (expected,):
            raise RunFailed(
                f"{self.task.name}: an initial state has {expected} numbers, "
                f"got {init_state.shape}",
                cause="the states belong to another version of LIBERO",
            )
        env = self._env
        self._sim.set_state_from_flattened(init_state)
        self._sim.forward()
        env._check_success()
        env._post_process()
        env._update_observables(force=True)


def _follow(env: Any) -> Any:
    """``mujoco.MjData`` that shows where everything was when the state was last observed.

    robosuite observes 2 ms before a control step ends, its images as well as its state.
    """
    import mujoco

    source = env.sim.data._data
    shown = mujoco.MjData(env.sim.model._model)
    pairs = [(getattr(shown, name), getattr(source, name)) for name in _DRAWN]
    observable = env._observables[_OBSERVED[0]]
    sensor = observable._sensor

    @functools.wraps(sensor)  # robosuite marks its sensors by attributes
    def observe(cache: Any) -> Any:
        for target, values in pairs:
            target[:] = values
        return sensor(cache)

    observable._sensor = observe
    return shown


# Of MuJoCo's data, what an image is drawn from.
_DRAWN = (
    "xpos",
    "xmat",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
    "cam_xpos",
    "cam_xmat",
    "light_xpos",
    "light_xdir",
)

_OBSERVED = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")

# What LIBERO writes into the model: where fixtures stand, and how a lit stove looks.
_CHANGED_BY_EPISODES = ("body_pos", "body_quat", "site_rgba", "geom_rgba")


def _build(task: SuiteTask) -> Any:
    libero = require_libero()
    with quiet():
        import robosuite
        from libero.libero.envs.bddl_utils import get_problem_info
        from robosuite.utils.errors import RandomizationError

        problem = get_problem_info(str(task.bddl))["problem_name"]
        # The order of LIBERO's evaluation, seed, build, place, decides where fixtures stand.
        np.random.seed(ENV_SEED)
        for _ in range(_MAX_TRIES):
            try:
                env = libero.envs.TASK_MAPPING[problem](
                    str(task.bddl),
                    robots=["Panda"],
                    controller_configs=robosuite.load_controller_config(
                        default_controller="OSC_POSE"
                    ),
                    gripper_types="default",
                    initialization_noise=None,
                    use_camera_obs=False,
                    has_renderer=False,
                    has_offscreen_renderer=False,
                    control_freq=CONTROL_HZ,
                    horizon=10**9,
                    ignore_done=True,
                    hard_reset=False,
                )
                break
            except RandomizationError:
                continue
        else:
            raise RunFailed(f"{task.name}: no room for all objects in {_MAX_TRIES} tries")
    env.visualize(vis_settings=dict.fromkeys(env._visualizations, False))
    for name, observable in env._observables.items():
        observable.set_enabled(name in _OBSERVED)
        observable.set_active(name in _OBSERVED)
    return env
