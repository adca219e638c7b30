"""Our tiny models with the weights and inputs that the references get."""

from __future__ import annotations

from pathlib import Path

import torch
from fluxvla_pi.names import LEROBOT
from fluxvla_pi.pi0 import PI0FlowMatching
from fluxvla_pi.pi0_fast import PI0FAST
from fluxvla_pi.pi05 import PI05FlowMatching

from tests.oracles import fill

from .oracles.pi_inputs import FAST_SIZES, SIZES, STATES, fast_inputs, inputs

GOLDEN = Path(__file__).parent / "golden"
FAST = {"type": "FastTokenizer", "model_path": str(GOLDEN / "fast")}
"""A tokenizer of actions, as a published one is stored."""


def model_of(family, layout=None, **settings):
    """A tiny ``pi0`` or ``pi05``; of a layout with every tensor by its published name.

    The embedding's name is ``embed_tokens`` there, which every reference has when it is built.
    """
    torch.manual_seed(0)
    if family == "pi0":
        model = PI0FlowMatching(**{**SIZES, "max_state_dim": STATES, **settings})
    else:
        model = PI05FlowMatching(**{**SIZES, **settings})
    return model.eval() if layout is None else filled(model, layout)


def fast_model(**settings):
    """A tiny PI0-FAST with LeRobot's weights, whose head is not tied."""
    torch.manual_seed(0)
    model = PI0FAST(FAST, **{**FAST_SIZES, "tied_head": False, **settings})
    return filled(model, LEROBOT)


def filled(model, layout):
    """``model`` with every tensor by its name in ``layout``."""
    state = {
        name: torch.from_numpy(fill.weight(layout.theirs(name), tuple(tensor.shape)))
        for name, tensor in model.state_dict().items()
    }
    model.load_state_dict(state)
    return model.eval()


def fast_batch():
    """``fast_inputs`` as PI0-FAST's ``forward`` takes them."""
    return {key: torch.from_numpy(value) for key, value in fast_inputs().items()}


def training_batch():
    """``inputs`` as ``forward`` takes them: one draw for each sample."""
    batch = {key: torch.from_numpy(value) for key, value in inputs().items()}
    batch["time"] = 1 - batch.pop("tau")[:, None]
    batch["noise"] = batch["noise"][:, None]
    return batch


def acting_batch():
    """``inputs`` as ``predict_action`` takes them."""
    batch = {key: torch.from_numpy(value) for key, value in inputs().items()}
    return {key: v for key, v in batch.items() if key not in ("actions", "tau")}


def relative(found, expected):
    """The largest difference, by the largest number that is expected."""
    return ((found - expected).abs().max() / expected.abs().max()).item()
