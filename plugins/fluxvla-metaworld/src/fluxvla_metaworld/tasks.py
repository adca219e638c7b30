"""Meta-World's 50 tasks and their language instructions.

The names are the package's own. It has no instructions; these are plain sentences for what each
task's success function asks for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fluxvla_core.errors import ConfigError

INSTRUCTIONS: Mapping[str, str] = {
    "assembly-v3": "pick up the ring and put it on the peg",
    "basketball-v3": "put the ball through the hoop",
    "bin-picking-v3": "move the block from one bin into the other",
    "box-close-v3": "put the lid on the box",
    "button-press-topdown-v3": "press the button from above",
    "button-press-topdown-wall-v3": "press the button behind the wall from above",
    "button-press-v3": "press the button from the front",
    "button-press-wall-v3": "reach around the wall and press the button",
    "coffee-button-v3": "press the coffee machine's button",
    "coffee-pull-v3": "pull the mug away from the coffee machine",
    "coffee-push-v3": "push the mug under the coffee machine",
    "dial-turn-v3": "turn the dial",
    "disassemble-v3": "take the ring off the peg",
    "door-close-v3": "close the door",
    "door-lock-v3": "lock the door",
    "door-open-v3": "open the door",
    "door-unlock-v3": "unlock the door",
    "hand-insert-v3": "put the hand into the hole",
    "drawer-close-v3": "close the drawer",
    "drawer-open-v3": "open the drawer",
    "faucet-open-v3": "open the faucet",
    "faucet-close-v3": "close the faucet",
    "hammer-v3": "drive the nail in with the hammer",
    "handle-press-side-v3": "press the handle down from the side",
    "handle-press-v3": "press the handle down",
    "handle-pull-side-v3": "pull the handle up from the side",
    "handle-pull-v3": "pull the handle up",
    "lever-pull-v3": "pull the lever up",
    "pick-place-wall-v3": "lift the puck over the wall to the goal",
    "pick-out-of-hole-v3": "take the puck out of the hole",
    "pick-place-v3": "pick up the puck and hold it at the goal",
    "plate-slide-v3": "slide the plate into the cabinet",
    "plate-slide-side-v3": "slide the plate sideways into the cabinet",
    "plate-slide-back-v3": "slide the plate out of the cabinet",
    "plate-slide-back-side-v3": "slide the plate sideways out of the cabinet",
    "peg-insert-side-v3": "put the peg into the hole in the side",
    "peg-unplug-side-v3": "pull the peg out of the hole in the side",
    "soccer-v3": "push the ball into the net",
    "stick-push-v3": "push the container with the stick",
    "stick-pull-v3": "pull the container with the stick",
    "push-v3": "push the puck to the goal",
    "push-wall-v3": "push the puck around the wall to the goal",
    "push-back-v3": "pull the puck back to the goal",
    "reach-v3": "reach the goal",
    "reach-wall-v3": "reach over the wall to the goal",
    "shelf-place-v3": "put the block on the shelf",
    "sweep-into-v3": "sweep the puck into the hole",
    "sweep-v3": "sweep the puck off the table",
    "window-open-v3": "open the window",
    "window-close-v3": "close the window",
}

MT10 = (
    "reach-v3",
    "push-v3",
    "pick-place-v3",
    "door-open-v3",
    "drawer-open-v3",
    "drawer-close-v3",
    "button-press-topdown-v3",
    "peg-insert-side-v3",
    "window-open-v3",
    "window-close-v3",
)
"""The benchmark MT10's tasks."""

SETS: Mapping[str, tuple[str, ...]] = {"MT10": MT10, "MT50": tuple(INSTRUCTIONS)}


def choose_tasks(wanted: str | Sequence[str]) -> tuple[str, ...]:
    """Names of tasks: those of a set (``MT10``, ``MT50``), or the ones that are named.

    Raises:
        ConfigError: there is no such set or task, or one is named twice.
    """
    if isinstance(wanted, str):
        if wanted not in SETS:
            raise ConfigError(
                f"tasks: {wanted!r} is not a set of tasks; there are {', '.join(SETS)}",
                next="name single tasks in a list",
            )
        return SETS[wanted]
    chosen = tuple(wanted)
    unknown = [name for name in chosen if name not in INSTRUCTIONS]
    if unknown:
        raise ConfigError(
            f"Meta-World has no task {unknown[0]!r}; it has {', '.join(sorted(INSTRUCTIONS))}"
        )
    if not chosen or len(set(chosen)) != len(chosen):
        raise ConfigError(f"tasks must name each task once, got {list(chosen)}")
    return chosen
