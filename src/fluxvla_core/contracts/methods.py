"""What the core calls on the classes of each registry: what ``contracts.check`` asks them for.

``docs/writing-a-plugin.md`` has this as a table, with the arguments' names and who calls.
"""

from __future__ import annotations

from collections.abc import Mapping

Arguments = int | tuple[str, ...] | None
"""What a method is given, without ``self``: so many positional arguments, keywords of these names,
or (None) what the class itself says that it wants."""

Methods = Mapping[str, Arguments]

ANY_OTHER = "any other"  # no name that a parameter can have: only ``**more`` takes it

_NOTHING: tuple[Methods, ...] = ({},)
_HOOKS = (
    *("run_started", "run_finished", "before_step", "after_step", "checkpoint_saved"),
    *("episode_started", "observed", "inferred", "action_sent", "episode_finished"),
)

NEEDS: Mapping[str, tuple[Methods, ...]] = {
    "runners": ({"run": 0, "run_setup": 0},),
    # One of the specification's shape has get_frame and commands of its own; what it lacks is
    # asked for when it is built, where the config can supply an embodiment.
    "operators": ({"get_frame": 0},),
    "vlas": ({"forward": None}, {"predict_action": None}),
    # Parts of a model: called by the model that builds them, as the two of them agree.
    "vision_backbones": _NOTHING,
    "llm_backbones": _NOTHING,
    "vlm_backbones": _NOTHING,
    "projectors": _NOTHING,
    "heads": _NOTHING,
    "datasets": (
        {"__len__": 0, "get_sample": 2},
        {"__len__": 0, "get_samples": 1},
        {"__call__": 1},
    ),
    "transforms": ({"__call__": 1},),
    "collators": ({"__call__": 1},),
    "tokenizers": ({"encode": 1},),
    "processors": _NOTHING,
    "metrics": (
        {
            "start": 2,
            "commit": ("global_step", "epoch", "loss", "lr", ANY_OTHER),
            "push": 0,
            "sync": 0,
            "state_dict": 0,
            "load_state_dict": 1,
            "finalize": 0,
        },
    ),
    "optimizers": ({"build": 2},),
    "action_filters": ({"__call__": 1},),
    "hooks": tuple({name: None} for name in _HOOKS),
    "environments": ({"reset": 2, "step": 1, "observe": 1, "close": 0},),
    "policies": ({"reset": 1, "predict_action": 1},),
    "commands": ({"add_arguments": 1, "run": 1},),
}
"""Registry -> sets of methods, one of which must be there as a whole."""

TRAIN_RUNNER: Methods = {"run": 1, "run_setup": ("n_train_examples",)}
RANDOM_TRANSFORM: Methods = {"__call__": 2}
FULL_OPERATOR: Methods = {"connect": 0, "get_frame": 0, "send_action": 1, "stop": 0, "close": 0}

MAY_HAVE: Mapping[str, Methods] = {
    "operators": {
        "get_state": 0,
        "state_stamp": 0,
        "task_done": 0,
        "task_success": 0,
        "begin_episode": 2,
        "pictures_after": 2,
    },
    "vlas": {"fsdp_units": 0},
    "datasets": {"get_samples": 1, "prepare": 1, "use_seed": 1, "use_statistics": 1},
    "transforms": {"denormalizer": 2, "defer": 1},
    "tokenizers": {"save_pretrained": 1},
    "action_filters": {"bind": 1, "reset": 1},
    "environments": {"state_hash": 0, "others": 1, "tell": 1},
    "policies": {"enter": 1, "continue_action": 2},
}
"""What a class may have besides (``contracts.optional`` has some of it): checked where it is."""
