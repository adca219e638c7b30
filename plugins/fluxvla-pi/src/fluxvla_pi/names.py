"""Names of tensors in published files, and ours.

Layouts of the same weights are in use: openpi's PyTorch files, LeRobot's, which puts ``model.`` in
front, and those of transformers' ``PI0ForConditionalGeneration``, which has other names when it is
saved. Their differences:

* the embedding of words is ``embed_tokens`` (transformers), or ``lm_head`` (openpi, whose tied
  weights are saved once), or both (LeRobot, which unties them; ``embed_tokens`` is what it uses);
* vision towers are named with or without ``.vision_model``, by the version of transformers;
* the expert has a vocabulary that nothing uses: it is not read, and written as zeros.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from fluxvla_core.errors import CheckpointError

_EMBEDDING = "llm_backbone.embed_tokens.weight"
_TOWER = ".vision_tower."
_SHOWN = 5


@dataclass(frozen=True)
class Layout:
    """Where a file has what.

    Args:
        prefixes: beginnings of our names and of theirs; those that are not listed are the same.
        root: in front of all of theirs.
        unused: theirs that no computation uses.
        head: theirs of the language model's output, the embedding's twin; empty if it has none.
        tower: what follows ``vision_tower.``.
    """

    prefixes: Mapping[str, str]
    root: str = ""
    unused: tuple[str, ...] = ()
    head: str = ""
    tower: str = ""

    def theirs(self, name: str) -> str:
        """Their name of our tensor ``name``."""
        for ours, theirs in self.prefixes.items():
            if name.startswith(ours):
                return self.root + theirs + name[len(ours) :]
        return self.root + name


def _tower(inside: str) -> dict[str, str]:
    return {
        "vision_backbone.layers.": f"{inside}encoder.layers.",
        "vision_backbone.patch_embedding.": f"{inside}embeddings.patch_embedding.",
        "vision_backbone.position_embedding.": f"{inside}embeddings.position_embedding.",
        "vision_backbone.post_layernorm.": f"{inside}post_layernorm.",
    }


_PALIGEMMA = "paligemma_with_expert.paligemma."
_EXPERT = "paligemma_with_expert.gemma_expert."


def _joined(root: str) -> Layout:
    prefixes = {
        **_tower(f"{_PALIGEMMA}model.vision_tower.vision_model."),
        "projector.": f"{_PALIGEMMA}model.multi_modal_projector.linear.",
        "llm_backbone.": f"{_PALIGEMMA}model.language_model.",
        "llm_expert.": f"{_EXPERT}model.",
        "lm_head.": f"{_PALIGEMMA}lm_head.",
    }
    unused = (f"{root}{_EXPERT}lm_head.weight",)
    return Layout(prefixes, root, unused, f"{root}{_PALIGEMMA}lm_head.weight", "vision_model.")


OPENPI = _joined("")
LEROBOT = _joined("model.")
TRANSFORMERS = Layout(
    {
        **_tower("model.vlm.vision_tower."),
        "projector.": "model.vlm.multi_modal_projector.linear.",
        "llm_backbone.": "model.vlm.language_model.",
        "llm_expert.": "model.dit.",
        "action_in_proj.": "embed_action_time.action_in_proj.",
        "state_proj.": "embed_action_time.state_proj.",
        "action_time_mlp_in.": "embed_action_time.action_time_mlp_in.",
        "action_time_mlp_out.": "embed_action_time.action_time_mlp_out.",
    },
    unused=("model.dit.embed_tokens.weight", "lm_head.weight"),
)
TRANSFORMERS_SAVED = Layout(
    {
        **_tower(f"{_PALIGEMMA}model.vision_tower.vision_model."),
        "projector.": f"{_PALIGEMMA}model.multi_modal_projector.linear.",
        "llm_backbone.": f"{_PALIGEMMA}model.language_model.model.",
        "llm_expert.": f"{_EXPERT}model.",
    },
    unused=(f"{_EXPERT}lm_head.weight",),
    tower="vision_model.",
)
"""What transformers 5.23 makes of its names when it saves: nearly openpi's."""
_BEGINNINGS = {
    f"{_PALIGEMMA}model.language_model.model.": TRANSFORMERS_SAVED,
    "model.paligemma_with_expert.": LEROBOT,
    "paligemma_with_expert.": OPENPI,
    "model.vlm.": TRANSFORMERS,
}


def layout_of(names: Iterable[str], where: str) -> Layout:
    """The layout that a file's ``names`` are of.

    Raises:
        CheckpointError: none that is known.
    """
    listed = sorted(names)
    for beginning, layout in _BEGINNINGS.items():
        if any(name.startswith(beginning) for name in listed):
            return layout
    raise CheckpointError(
        f"no tensor's name begins with {', '.join(_BEGINNINGS)}; there are {_list(listed)}",
        where=where,
        cause="the file is of another model",
    )


def sources(ours: Collection[str], names: Collection[str], where: str) -> dict[str, str]:
    """Our tensors' names -> the names in a file that has ``names``: each once, and all used.

    Raises:
        CheckpointError: the file lacks tensors of the model, or has others; they are listed.
    """
    layout = layout_of(names, where)
    have = actual_names(names, layout)
    known = {name: layout.theirs(name) for name in ours}
    if layout.head and known[_EMBEDDING] not in have:
        known[_EMBEDDING] = layout.head
    missing = sorted(theirs for theirs in known.values() if theirs not in have)
    extra = sorted(set(have) - set(known.values()) - {*layout.unused, layout.head})
    if missing or extra:
        raise CheckpointError(
            f"tensors and model do not agree: {len(missing)} missing ({_list(missing)}), "
            f"{len(extra)} of no use ({_list(extra)})",
            where=where,
            cause="the model of the file is of another family or size",
        )
    return {name: have[theirs] for name, theirs in known.items()}


def actual_names(names: Iterable[str], layout: Layout) -> dict[str, str]:
    """The names that ``layout`` has -> those in a file of another version of transformers."""
    return {_long(name, layout): name for name in names}


def published(ours: Collection[str], layout: Layout) -> dict[str, str]:
    """Names to write -> our names that they are filled from, for ``layout``.

    The embedding stands under both of its names in LeRobot's, but where the head is not tied to
    it, and under the head's in openpi's, as their own files have it. ``layout.unused`` is not among
    them.
    """
    found = {layout.theirs(name): name for name in ours}
    if layout.head:
        if layout is OPENPI:
            del found[layout.theirs(_EMBEDDING)]
        found.setdefault(layout.head, _EMBEDDING)
    return found


def _long(name: str, layout: Layout) -> str:
    """``name`` with what its version of transformers left out behind ``vision_tower``."""
    before, tower, after = name.partition(_TOWER)
    if not tower or not layout.tower or after.startswith(layout.tower):
        return name
    return before + tower + layout.tower + after


def _list(names: Sequence[str]) -> str:
    if not names:
        return "none"
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
