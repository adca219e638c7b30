"""What every results file begins with."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

import pytest

from benchmarks import _results


def test_out_is_named_after_the_benchmark(tmp_path: Path) -> None:
    parser = _results.options("/somewhere/benchmarks/startup.py")
    assert parser.parse_args([]).out == _results.FOLDER / "startup.json"
    assert parser.parse_args(["--out", str(tmp_path)]).out == tmp_path
    with pytest.raises(SystemExit):
        parser.parse_args(["--ou", "x"])


def test_head_says_what_runs_where() -> None:
    found = _results.head("numpy", "no-such-distribution")
    assert found["python"] == platform.python_version()
    assert found["machine"] == f"{platform.machine()}, {os.cpu_count()} CPUs"
    assert found["load_before"] >= 0
    assert set(found["versions"]) == {"fluxvla-core", "numpy", "no-such-distribution"}
    assert found["versions"]["numpy"] == __import__("numpy").__version__
    assert found["versions"]["no-such-distribution"] is None


def test_results_are_kept_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "results" / "x.json"
    _results.keep(out, {"ratio": 1.5})
    assert json.loads(out.read_text(encoding="utf-8")) == {"ratio": 1.5}
    assert json.loads(capsys.readouterr().out) == {"ratio": 1.5}
    _results.keep(out, {"ratio": 2.5}, show=False)
    assert json.loads(out.read_text(encoding="utf-8")) == {"ratio": 2.5}
    assert capsys.readouterr().out == f"written to {out}\n"
