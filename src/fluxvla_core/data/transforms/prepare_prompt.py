"""Prompts of PaliGemma policies: the instruction as PI0 reads it, or with the state, as PI0.5 and
PI0-FAST do.

The texts are those of openpi's ``PaligemmaTokenizer``; ``ProcessPrompts`` makes tokens of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import Transform
from fluxvla_core.errors import ConfigError

BINS = 256


class PreparePrompt(Transform):
    """Add ``prompt``: the instruction and a newline, where PaliGemma's answer begins.

    Args:
        clean: remove blanks at both ends, and make a blank of each ``_`` and newline inside, as
            openpi does; LeRobot leaves the instruction as it is.

    Raises:
        ConfigError: there is no instruction.
    """

    keeps_images = True

    def __init__(self, clean: bool = True) -> None:
        self.clean = clean

    def __call__(self, sample: Sample) -> Sample:
        text = _instruction(sample, type(self).__name__)
        text = cleaned(text) if self.clean else text.removesuffix("\n")
        return {**sample, "prompt": f"{text}\n"}


class PreparePromptWithState(Transform):
    """Add ``prompt``: ``Task: <instruction>, State: <numbers>;``, a newline and ``ending``.

    The numbers are the bins of the normalised ``states``: 256 equal ones from -1 to 1, and -1 below
    them. So it belongs after the normalisation.

    Args:
        state_dim: so many of the states, where they are padded; all if None.
        ending: ``Action: `` for PI0.5; nothing for PI0-FAST, whose answer begins with it.

    Raises:
        ConfigError: there is no instruction, or there are fewer states.
    """

    keeps_images = True

    def __init__(self, state_dim: int | None = None, ending: str = "Action: ") -> None:
        if state_dim is not None and state_dim < 1:
            raise ConfigError(
                f"PreparePromptWithState: state_dim must be at least 1, got {state_dim}"
            )
        self.state_dim = state_dim
        self.ending = ending

    def __call__(self, sample: Sample) -> Sample:
        text = cleaned(_instruction(sample, type(self).__name__))
        states = np.asarray(sample["states"]).reshape(-1)
        if self.state_dim is not None and len(states) < self.state_dim:
            raise ConfigError(
                f"PreparePromptWithState: state_dim is {self.state_dim}, the sample has "
                f"{len(states)} states"
            )
        numbers = " ".join(map(str, state_bins(states[: self.state_dim])))
        return {**sample, "prompt": f"Task: {text}, State: {numbers};\n{self.ending}"}


def cleaned(text: str) -> str:
    """``text`` without blanks around it, in one line, with blanks for underscores."""
    return text.strip().replace("_", " ").replace("\n", " ")


def state_bins(states: Any) -> list[int]:
    """The bin of each state, 0..255 within -1..1; what is beyond 1 is in the last one."""
    edges = np.linspace(-1, 1, BINS + 1)[:-1]
    return [int(number) for number in np.digitize(states, edges) - 1]


def _instruction(sample: Sample, who: str) -> str:
    text = sample.get("task_description")
    if not isinstance(text, str) or not text.strip():
        raise ConfigError(
            f"{who}: there is no instruction: 'task_description' is not in the sample ({text!r})"
        )
    return text
