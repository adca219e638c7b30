"""Which torch is installed where."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from tools import torch_build
from tools.envs import Env
from tools.shell import StepFailed


@pytest.mark.parametrize(
    ("gpu", "platform", "version", "ways"),
    [
        (False, "linux", "2.13.0", ["cpu-wheel", "uv", "plain"]),
        (True, "linux", "2.13.0", ["plain"]),
        (False, "darwin", "2.13.0", ["plain"]),
        (False, "linux", "2.13.0+cpu", ["plain"]),
    ],
)
def test_ways_to_install(gpu: bool, platform: str, version: str, ways: list[str]) -> None:
    assert torch_build.attempts(version, gpu=gpu, platform=platform) == ways


def fake_smi(folder: Path, text: str, status: int = 0) -> None:
    folder.mkdir(exist_ok=True)
    program = folder / "nvidia-smi"
    program.write_text(f"#!/bin/sh\necho '{text}'\nexit {status}\n")
    program.chmod(program.stat().st_mode | stat.S_IEXEC)


@pytest.mark.parametrize(
    ("text", "status", "answer"),
    [
        ("GPU 0: NVIDIA X\nGPU 1: NVIDIA X", 0, 2),
        ("No devices were found", 0, 0),
        ("GPU 0", 9, 0),
    ],
)
def test_a_gpu_is_what_nvidia_smi_lists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, status: int, answer: int
) -> None:
    fake_smi(tmp_path / "bin", text, status)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert torch_build.nvidia_gpus() == answer


def test_no_nvidia_smi_no_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert torch_build.nvidia_gpus() == 0


class Shop:
    """Stands in for package indexes: it has what ``stock`` names, and notes what was asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *stock: str) -> None:
        self.asked: list[str] = []
        self.said: list[str] = []

        def run(env: Env, program: str, *words: object, **options: object) -> str:
            line = " ".join([program, *map(str, words)])
            self.asked.append(line)
            if not any(name in line for name in stock):
                raise StepFailed([line], 1, f"progress\nERROR: nothing for {words[-1]}\n")
            return ""

        monkeypatch.setattr(Env, "run", run)
        monkeypatch.setattr(torch_build, "nvidia_gpus", lambda: 0)

    def install(self) -> str:
        where = Path("env")
        return torch_build.install(Env(where), "2.13.0", Path("c.txt"), self.said.append)


def test_the_cpu_wheel_is_taken_where_pip_sees_it(monkeypatch: pytest.MonkeyPatch) -> None:
    shop = Shop(monkeypatch, "torch==2.13.0+cpu")
    assert shop.install() == "cpu-wheel"
    assert len(shop.asked) == 1
    assert "-c c.txt" in shop.asked[0]
    assert shop.said == []


def test_uv_is_asked_next(monkeypatch: pytest.MonkeyPatch) -> None:
    shop = Shop(monkeypatch, "version-check --no-compile uv", "--torch-backend=cpu")
    assert shop.install() == "uv"
    assert "--torch-backend=cpu -c c.txt torch==2.13.0" in shop.asked[-1]


def test_else_the_default_build_with_a_line_that_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    shop = Shop(monkeypatch, "-c c.txt torch==2.13.0")
    monkeypatch.setattr(
        torch_build,
        "_quietly",
        lambda *a: (_ for _ in ()).throw(StepFailed(["x"], 1, "WARNING\nERROR: no wheel\nhint\n")),
    )
    assert shop.install() == "plain"
    assert shop.said == [
        "no CPU build of torch 2.13.0 found (cpu-wheel: ERROR: no wheel; uv: ERROR: no wheel): "
        "installing the default build, which also works without a GPU but is several GB larger"
    ]


def test_no_torch_at_all_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    shop = Shop(monkeypatch)
    with pytest.raises(StepFailed, match=r"torch==2\.13\.0"):
        shop.install()
