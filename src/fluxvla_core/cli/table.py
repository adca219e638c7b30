"""The commands of ``fluxvla``: names, help lines and where each is, so that only one is imported.

A command is a class with ``help``, ``add_arguments(parser)`` and ``run(args) -> exit code``
(``contracts.Command``); a plugin's own (group ``fluxvla.commands``) is the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Entry(NamedTuple):
    """``target`` is ``module:Class``."""

    target: str
    help: str


COMMANDS: Mapping[str, Entry] = {
    "run": Entry("fluxvla_core.cli.run:Run", "run a section of a config: train, evaluate, deploy"),
    "config show": Entry(
        "fluxvla_core.cli.config_commands:Show", "print the config as it resolves"
    ),
    "config check": Entry(
        "fluxvla_core.cli.config_commands:Check", "check a config without importing anything"
    ),
    "plugins list": Entry("fluxvla_core.cli.plugin_list:List", "list what is installed"),
    "plugins show": Entry(
        "fluxvla_core.cli.plugin_show:Show", "show one class: its keys, its origin"
    ),
    "plugins doctor": Entry(
        "fluxvla_core.cli.doctor:Doctor", "look for broken and colliding installations"
    ),
    "data inspect": Entry("fluxvla_core.cli.data_commands:Inspect", "print what a dataset holds"),
    "data validate": Entry(
        "fluxvla_core.cli.data_commands:Validate", "read every row, decode every frame"
    ),
    "data stats": Entry(
        "fluxvla_core.cli.data_commands:Stats", "print exact statistics of a dataset"
    ),
    "data convert": Entry(
        "fluxvla_core.cli.data_commands:Convert", "write recordings, or LeRobot v2, as v3.0"
    ),
    "data finish": Entry(
        "fluxvla_core.cli.data_commands:Finish", "finish a recording that was cut short"
    ),
    "data collect": Entry(
        "fluxvla_core.cli.collect_command:Collect", "record demonstrations of a scripted expert"
    ),
    "eval compare": Entry(
        "fluxvla_core.cli.eval_commands:Compare", "compare two evaluations, pair by pair"
    ),
    "export": Entry(
        "fluxvla_core.cli.export_command:Export", "write what acts of a checkpoint into a folder"
    ),
    "report": Entry("fluxvla_core.report.command:Report", "write the HTML report of a work dir"),
    "version": Entry("fluxvla_core.cli.version:Version", "print the versions"),
}
