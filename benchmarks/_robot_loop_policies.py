"""Policies of ``robot_loop``: one computes all the time, the other also holds the GIL."""

from __future__ import annotations

import ctypes
import time
from typing import Any

import numpy as np
import torch
from fluxvla_aloha.embodiment import aloha_spec, start_pose

RATE_HZ, HORIZON = 50.0, 200
START_POSE = start_pose("viperx300")
LOCKED_S = 0.1


class TenMillion:
    """A transformer over patches of all images; swings both arms gently, whatever it sees."""

    action_rate_hz, horizon = RATE_HZ, HORIZON
    embodiment = aloha_spec()

    def __init__(self) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(0)
        layer = torch.nn.TransformerEncoderLayer(384, 6, 1536, 0.0, batch_first=True)
        self.encoder = torch.nn.TransformerEncoder(layer, 6, enable_nested_tensor=False).eval()
        self.patches = torch.nn.Linear(3 * 20 * 20, 384)
        self.seconds: list[float] = []

    @property
    def parameters(self) -> int:
        parts = (self.encoder, self.patches)
        return sum(p.numel() for part in parts for p in part.parameters())

    def reset(self, seed: int) -> None:
        self.seconds.clear()

    def predict_action(self, observation: dict[str, Any]) -> np.ndarray[Any, Any]:
        began = time.perf_counter()
        small = np.stack([image[::4, ::4] for image in observation["images"].values()])
        tokens = small.reshape(-1, 6, 20, 8, 20, 3).swapaxes(2, 3).reshape(1, -1, 1200)
        with torch.inference_mode():
            found = self.encoder(self.patches(torch.from_numpy(tokens).float() / 255)).mean()
        ahead = time.monotonic() + np.arange(1, HORIZON + 1) / RATE_HZ
        chunk = np.tile(np.array(START_POSE), (HORIZON, 1))
        chunk[:, [0, 7]] += 0.2 * np.sin(ahead)[:, None] + 1e-9 * float(found)
        self.seconds.append(time.perf_counter() - began)
        return chunk


class LockHolder(TenMillion):
    """Holds the GIL half of the time, for ``LOCKED_S`` in one call."""

    def __init__(self) -> None:
        super().__init__()
        # PyDLL does not give the lock up around a call; and it takes as long on a busy machine.
        self._keep = ctypes.PyDLL(None).usleep

    def predict_action(self, observation: dict[str, Any]) -> np.ndarray[Any, Any]:
        self._keep(round(LOCKED_S * 1e6))
        began = time.perf_counter()
        chunk = super().predict_action(observation)
        time.sleep(max(LOCKED_S - (time.perf_counter() - began), 0.0))
        return chunk


def warm_policy(kind: type[TenMillion] = TenMillion) -> TenMillion:
    """One whose libraries have what they want."""
    policy = kind()
    for _ in range(3):
        policy.predict_action({"images": {n: np.zeros((480, 640, 3), np.uint8) for n in range(3)}})
    return policy
