"""Public API for reading the files of a run, for reports and dashboards.

``episode_log`` names the events of an episode and sums them up; ``read_bag`` reads a recording.
``read_json``, ``parse_json`` and ``read_bytes`` read untrusted files: typed, bounded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.atomic import prepare_folder as prepare_folder
    from fluxvla_core.atomic import write_text as write_text
    from fluxvla_core.config.load import work_dirs_below as work_dirs_below
    from fluxvla_core.robot.recording import episode_log as episode_log
    from fluxvla_core.robot.recording.recorded import bag_of as bag_of
    from fluxvla_core.robot.recording.recorded import is_recording as is_recording
    from fluxvla_core.robot.recording.recorded import open_recording as open_recording
    from fluxvla_core.robot.recording.recorded import read_bag as read_bag
    from fluxvla_core.robot.recording.trace import EVENTS_FILE as EVENTS_FILE
    from fluxvla_core.robot.recording.trace import SUMMARY_FILE as SUMMARY_FILE
    from fluxvla_core.untrusted import parse_json as parse_json
    from fluxvla_core.untrusted import read_bytes as read_bytes
    from fluxvla_core.untrusted import read_json as read_json

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
