"""An HTML report of a work dir, and the command ``fluxvla report`` that writes it."""

from __future__ import annotations

from fluxvla_report.page import build_report

__all__ = ["build_report"]
