"""The numbers of the safety rules: defaults that suit an arm, and what a config may set."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from fluxvla_core.errors import ConfigError


@dataclass(frozen=True)
class SafetySettings:
    """Thresholds of every rule. There is no switch that turns a rule off.

    Args:
        velocity_scale, acceleration_scale: share of the embodiment's limits to use, in (0, 1].
        ramp_scale: share of the velocity limit on the way to the start pose, in (0, 1].
        max_age_s: how old the newest reading of any stream may be when a policy is asked.
        max_skew_s: how far the streams of one observation may be apart in time.
        tracking_error: how far a joint may stay behind its command, in rad (prismatic joints:
            in m, a tenth of it). Grippers are exempt: holding something is their purpose.
        tracking_time_s: for how long.
        jump_s: a chunk that asks a joint to be further away than it could go in this time at full
            speed is no motion, and stops.
        excess: a chunk that lies further beyond a position limit than this share of the joint's
            range stops; less is clamped. Grippers may be wanted four times as far beyond.
        starvation_s: how long the arm may hold and wait for the next chunk while it runs.
        first_chunk_s: how long the first answer of a policy may take (it may have to warm up), and
            any answer in a simulation whose time stands still meanwhile.
    """

    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    ramp_scale: float = 0.25
    max_age_s: float = 0.5
    max_skew_s: float = 0.25
    tracking_error: float = 0.3
    tracking_time_s: float = 0.25
    jump_s: float = 1.0
    excess: float = 0.25
    starvation_s: float = 2.0
    first_chunk_s: float = 120.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not math.isfinite(value) or value <= 0:
                raise ConfigError(f"safety.{field.name} must be a positive number, got {value!r}")
            if field.name.endswith("_scale") and value > 1:
                raise ConfigError(
                    f"safety.{field.name} must be above 0 and at most 1, got {value}",
                    cause="a scale uses a share of the robot's limits; it cannot lift them",
                )

    @classmethod
    def of(cls, value: Mapping[str, Any] | SafetySettings | None) -> SafetySettings:
        """Settings from a config's ``safety=dict(…)``; None means the defaults.

        Raises:
            ConfigError: a key is unknown (with the nearest one), or a value is out of its range.
        """
        if value is None:
            return cls()
        if isinstance(value, SafetySettings):
            return value
        if not isinstance(value, Mapping):
            raise ConfigError(f"safety must be a table, got {value!r}")
        names = [field.name for field in fields(cls)]
        for key in value:
            if key not in names:
                near = difflib.get_close_matches(str(key), names, 1)
                hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(names)}"
                raise ConfigError(f"safety has no setting {key!r}{hint}")
        return cls(**value)
