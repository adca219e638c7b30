"""From a work dir to one HTML page."""

from __future__ import annotations

from fluxvla_core.report.page import build_report

__all__ = ["build_report"]
