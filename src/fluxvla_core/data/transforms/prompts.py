"""Tokenise instructions: prompts as text to token ids and masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import build_tokenizer_from_cfg
from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import Tokenizer, Transform
from fluxvla_core.errors import ConfigError, quoted

Encoded = tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]
KEPT = 4096
"""Encoded texts that are kept: all instructions of a dataset, not every prompt with a state."""


class ProcessPrompts(Transform):
    """Tokenise the instruction: add ``lang_tokens`` int64 and ``lang_masks`` bool, ``(max_len,)``.

    The text is ``sample["prompt"]``, or ``sample["task_description"]`` where there is none.
    Padding follows on the tokenizer's ``padding_side``, right unless it says otherwise; the mask
    is True on real tokens.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, or one already built: ``encode(text)``
            gives ids, ``pad_token_id`` fills up.
        max_len: length of the result.

    Raises:
        ConfigError: the text is missing, or longer than ``max_len``: half an instruction is
            another instruction, so it is never cut.
    """

    keeps_images = True

    def __init__(self, tokenizer: Mapping[str, Any] | Any, max_len: int = 180) -> None:
        self._who = type(self).__name__
        if max_len < 1:
            raise ConfigError(f"{self._who}: max_len must be at least 1, got {max_len}")
        self.tokenizer = Tokenizer.adapt(build_tokenizer_from_cfg(tokenizer))
        self.max_len = max_len
        self.padding_side = self.tokenizer.padding_side
        # A dataset has a handful of instructions and millions of frames.
        self._known: dict[str, Encoded] = {}

    def __call__(self, sample: Sample) -> Sample:
        text = sample.get("prompt", sample.get("task_description"))
        if not isinstance(text, str) or not text.strip():
            raise ConfigError(
                f"{self._who}: there is no instruction: neither 'prompt' nor "
                f"'task_description' is in the sample ({text!r})"
            )
        if text not in self._known:
            if len(self._known) >= KEPT:
                self._known.clear()
            self._known[text] = self._pad(self._encode(text), text)
        tokens, mask = self._known[text]
        return {**sample, "lang_tokens": tokens.copy(), "lang_masks": mask.copy()}

    def _encode(self, text: str) -> Sequence[int]:
        ids: Sequence[int] = self.tokenizer.encode(text)
        return ids

    def _pad(self, ids: Sequence[int], text: str) -> Encoded:
        if len(ids) > self.max_len:
            raise ConfigError(
                f"{self._who}: the instruction {quoted(text)} has {len(ids)} tokens"
                f"{self._counted()}, "
                f"max_len is {self.max_len}",
                next=f"--set <{self._who}>.max_len={len(ids)} (or more) where the model "
                "is trained, or use shorter words",
            )
        pad = int(self.tokenizer.pad_token_id or 0)
        left = self.padding_side == "left"
        place = slice(self.max_len - len(ids), None) if left else slice(len(ids))
        tokens = np.full(self.max_len, pad, dtype=np.int64)
        mask = np.zeros(self.max_len, dtype=np.bool_)
        tokens[place], mask[place] = ids, True
        return tokens, mask

    def _counted(self) -> str:
        return ""


class ProcessPromptsWithImage(ProcessPrompts):
    """Tokenise a chat prompt with image placeholders, for models that take images between words.

    The text is ``<|im_start|>system``, the system's words, ``<|im_end|>``, ``<|im_start|>user``,
    for each camera ``<image 1><img>``, ``fixed_img_tokens`` times ``<IMG_CONTEXT>`` and
    ``</img>``, then the instruction, ``<|im_end|>`` and ``<|im_start|>assistant``, as Eagle 2 (the
    eyes of GR00T N1.5) was trained.

    Args:
        tokenizer, max_len: as of ``ProcessPrompts``; the places of images count.
        num_images: cameras, as many as ``img_keys`` names.
        fixed_img_tokens: places for each image.
        system_prompt: the system's words; none with an empty text.
        task_pos: ``after_images`` or ``before_images``.
        padding_side: ``left`` or ``right``.

    Raises:
        ConfigError: as ``ProcessPrompts``; ``<IMG_CONTEXT>`` is not a token of the tokenizer;
            samples have another number of images, or an instruction holds ``<IMG_CONTEXT>``.
    """

    keeps_images = True

    def __init__(
        self,
        tokenizer: Mapping[str, Any] | Any,
        max_len: int = 900,
        num_images: int = 3,
        fixed_img_tokens: int = 256,
        system_prompt: str = "You are a helpful assistant.",
        task_pos: str = "after_images",
        padding_side: str = "left",
    ) -> None:
        super().__init__(tokenizer, max_len)
        for name, value, known in (
            ("task_pos", task_pos, ("after_images", "before_images")),
            ("padding_side", padding_side, ("left", "right")),
        ):
            if value not in known:
                raise ConfigError(f"{self._who}: {name} {value!r} is not one of {', '.join(known)}")
        if num_images < 1 or fixed_img_tokens < 1:
            raise ConfigError(
                f"{self._who}: num_images {num_images} and fixed_img_tokens {fixed_img_tokens} "
                "must be at least 1"
            )
        self.num_images = num_images
        self.fixed_img_tokens = fixed_img_tokens
        self.system_prompt = system_prompt
        self.task_pos = task_pos
        self.padding_side = padding_side
        self._place = self._find_place()

    def __call__(self, sample: Sample) -> Sample:
        seen = len(sample.get("img_masks", ()))
        if seen not in (0, self.num_images):
            raise ConfigError(
                f"{self._who}: num_images is {self.num_images}, the sample has {seen} images",
                next=f"as many as there are img_keys: --set <{self._who}>.num_images={seen}",
            )
        return super().__call__(sample)

    def _encode(self, text: str) -> Sequence[int]:
        ids = super()._encode(self._chat(text))
        found, expected = list(ids).count(self._place), self.num_images * self.fixed_img_tokens
        if found != expected:
            raise ConfigError(
                f"{self._who}: the chat around the instruction {quoted(text)} has {found} "
                f"places for images, {expected} expected",
                cause=f"the instruction itself holds {_PLACE}",
            )
        return ids

    def _chat(self, text: str) -> str:
        images = "".join(
            f"<image {i}><img>{_PLACE * self.fixed_img_tokens}</img>"
            for i in range(1, self.num_images + 1)
        )
        first = self.task_pos == "before_images"
        content = f"{text}\n{images}" if first else f"{images}{text}"
        system = _turn("system", self.system_prompt) if self.system_prompt else ""
        return f"{system}{_turn('user', content)}<|im_start|>assistant\n"

    def _find_place(self) -> int:
        """The token that is the placeholder of an image's part."""
        encode = self.tokenizer.encode
        added = Counter(encode(_PLACE * 2)) - Counter(encode(_PLACE))
        if list(added.values()) != [1]:
            raise ConfigError(
                f"{self._who}: {_PLACE} is not a token of this tokenizer, it is cut into several",
                cause="the tokenizer is not the one of the model that sees images",
            )
        return int(next(iter(added)))

    def _counted(self) -> str:
        return f" with {self.num_images} x {self.fixed_img_tokens} places for images"


_PLACE = "<IMG_CONTEXT>"


def _turn(role: str, content: str) -> str:
    return f"<|im_start|>{role}\n{content}<|im_end|>\n"


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
