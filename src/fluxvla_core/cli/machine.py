"""Facts about the machine, for ``fluxvla plugins doctor``: CUDA, ROS 2, rendering, disks.

Libraries (torch, rclpy, MuJoCo) are imported in processes of their own: a missing libEGL can end
one.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.plugins._metadata import version

SHM = Path("/dev/shm")
_GIB = 1 << 30
_SMALL_SHM = _GIB
_SMALL_DISK = 5 * _GIB
_LAST_DOMAIN = 232
_ROS = {
    "distribution": "ROS_DISTRO",
    "rmw": "RMW_IMPLEMENTATION",
    "domain_id": "ROS_DOMAIN_ID",
    "discovery_range": "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "static_peers": "ROS_STATIC_PEERS",
    "transports": "FASTDDS_BUILTIN_TRANSPORTS",
    "profiles_file": "FASTDDS_DEFAULT_PROFILES_FILE",
}
"""Key -> the environment variable that says it."""
# What ROS 2 does where a variable is not set; https://docs.ros.org/en/kilted, environment
# variables and "Improved dynamic discovery". Fast DDS uses shared memory by default.
_SHARING = ("DEFAULT", "LARGE_DATA", "SHM")  # of FASTDDS_BUILTIN_TRANSPORTS
_ROS_DEFAULTS = {"domain_id": "0", "discovery_range": "SUBNET"}

_TORCH = """
import json, torch
nccl = getattr(torch.cuda, "nccl", None)
built = torch.version.cuda is not None and torch.distributed.is_available()
print(json.dumps({
    "cuda": torch.version.cuda,
    "cudnn": torch.backends.cudnn.version(),
    "nccl": ".".join(map(str, nccl.version())) if nccl and built else None,
    "devices": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
}))
"""
_RCLPY = """
import json
from fluxvla_core.errors import FluxError
from fluxvla_core.ros2.connection import require_rclpy
try:
    require_rclpy()
    print(json.dumps({"works": True}))
except FluxError as error:
    print(json.dumps({"works": False, "error": str(error)}))
"""
_GL = """
import json, mujoco
context = mujoco.GLContext(32, 32)
context.make_current()
from OpenGL import GL
print(json.dumps({"works": True, "renderer": GL.glGetString(GL.GL_RENDERER).decode()}))
"""


def facts(limit_s: float | None, environ: Mapping[str, str] = os.environ) -> dict[str, Any]:
    """JSON values; docs/files.md documents the keys.

    Args:
        limit_s: seconds that one import may take; None imports nothing, and facts that need an
            import are None then.
    """
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpus": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "torch": _torch(limit_s),
        "ros2": _ros2(limit_s, environ),
        "rendering": _rendering(limit_s, environ),
        "disks": _disks([Path.cwd(), Path(tempfile.gettempdir())]),
        "shared_memory": _space(SHM),
    }


def remarks(facts: Mapping[str, Any]) -> Iterator[tuple[bool, str]]:
    """Problems (True) of a machine with these facts, and possible ones (False)."""
    if facts["torch"]["error"]:
        yield True, f"torch {facts['torch']['version']} is installed and {facts['torch']['error']}"
    ros2 = facts["ros2"]
    if ros2["error"]:
        yield True, ros2["error"].replace("\n", ";")
    domain = ros2["domain_id"]
    if domain is not None and not (domain.isdecimal() and int(domain) <= _LAST_DOMAIN):
        text = f"ROS_DOMAIN_ID is {domain!r}, and a ROS domain is a number from 0 to {_LAST_DOMAIN}"
        yield True, text
    if ros2["profiles_file"] and not Path(ros2["profiles_file"]).is_file():
        text = f"FASTDDS_DEFAULT_PROFILES_FILE names {ros2['profiles_file']}, which is not there: "
        yield True, text + "Fast DDS goes on without it"
    rendering = facts["rendering"]
    if rendering["error"]:
        text = f"MuJoCo cannot render (MUJOCO_GL={rendering['backend'] or ''}): "
        text += f"{rendering['error']}; without a display, MUJOCO_GL=egl needs libegl1 and, on a "
        yield False, text + "machine without a GPU, libegl-mesa0 and libgl1-mesa-dri"
    for disk in facts["disks"]:
        if disk["free_bytes"] < _SMALL_DISK:
            yield False, f"{_size(disk['free_bytes'])} are free in {disk['path']}"
    shm = facts["shared_memory"]
    if shm is not None and shm["total_bytes"] < _SMALL_SHM:
        text = f"{SHM} has {_size(shm['total_bytes'])}, and workers that load data pass batches "
        yield False, text + "through it: docker run --shm-size=8g"


def lines(facts: Mapping[str, Any]) -> list[str]:
    """The facts for people, one a line."""
    torch, ros2, rendering = facts["torch"], facts["ros2"], facts["rendering"]
    rows = [("python", f"{facts['python']}, {facts['platform']}, {facts['cpus']} CPUs")]
    if torch["version"] is None:
        rows.append(("torch", "not installed"))
    elif torch["devices"] is None:
        rows.append(("torch", torch["version"]))
    else:
        parts = [torch["version"]]
        parts += [f"{n} {torch[k]}" for n, k in (("CUDA", "cuda"), ("NCCL", "nccl")) if torch[k]]
        parts.append(", ".join(torch["devices"]) or "no GPU")
        rows.append(("torch", "; ".join(parts)))
    rows.append(("ROS 2", _ros2_line(ros2)))
    if rendering["mujoco"] is None:
        rows.append(("rendering", "no MuJoCo"))
    else:
        backend = f"MUJOCO_GL={rendering['backend'] or '(not set)'}"
        rows.append(("rendering", "; ".join(filter(None, [rendering["renderer"], backend]))))
    for disk in facts["disks"]:
        rows.append(("disk", f"{_free(disk)} in {disk['path']}"))
    shm = facts["shared_memory"]
    rows.append((str(SHM), _free(shm) if shm else "not there"))
    return [f"  {name:9}  {text}" for name, text in rows]


def _ros2_line(ros2: Mapping[str, Any]) -> str:
    there = ros2["distribution"] or ros2["rclpy"]
    if not there:
        return "not found (ROS_DISTRO is not set, and rclpy is not installed)"
    parts = [
        ros2["distribution"] or f"rclpy {ros2['rclpy']}",
        f"RMW {ros2['rmw'] or '(default)'}",
        f"domain {ros2['domain_id']}",
        f"discovery {ros2['discovery_range']}",
    ]
    for name in ("static_peers", "transports", "profiles_file"):
        if ros2[name]:
            parts.append(f"{_ROS[name]}={ros2[name]}")
    fast = ros2["rmw"] in (None, "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
    if fast and not ros2["profiles_file"]:
        shares = (ros2["transports"] or "DEFAULT").startswith(_SHARING)
        parts.append("shared memory" if shares else "no shared memory")
    return "; ".join(parts)


def _torch(limit_s: float | None) -> dict[str, Any]:
    have = version("torch")
    found: dict[str, Any] = {
        "version": have,
        **dict.fromkeys(("cuda", "cudnn", "nccl", "devices", "error")),
    }
    return found if have is None or limit_s is None else found | _asked(_TORCH, limit_s)


def _ros2(limit_s: float | None, environ: Mapping[str, str]) -> dict[str, Any]:
    settings = {key: environ.get(name) or _ROS_DEFAULTS.get(key) for key, name in _ROS.items()}
    facts: dict[str, Any] = {**settings, "rclpy": version("rclpy"), "works": None, "error": None}
    if limit_s is None or not (facts["distribution"] or facts["rclpy"]):
        return facts
    return facts | _asked(_RCLPY, limit_s)


def _rendering(limit_s: float | None, environ: Mapping[str, str]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "mujoco": version("mujoco"),
        "backend": environ.get("MUJOCO_GL"),
        **dict.fromkeys(("works", "renderer", "error")),
    }
    if limit_s is None or found["mujoco"] is None:
        return found
    answer = _asked(_GL, limit_s)
    return found | answer | {"works": answer.get("works", False)}


def _disks(paths: list[Path]) -> list[dict[str, Any]]:
    """Free space by file system, each once."""
    found: dict[int, dict[str, Any]] = {}
    for path in paths:
        space = _space(path)
        if space is not None:
            found.setdefault(path.stat().st_dev, space)
    return list(found.values())


def _space(path: Path) -> dict[str, Any] | None:
    try:
        usage = shutil.disk_usage(path)
    except OSError:
        return None
    return {"path": str(path), "free_bytes": usage.free, "total_bytes": usage.total}


def _asked(program: str, limit_s: float) -> dict[str, Any]:
    """The JSON object that a program prints, or its ``error`` in one line."""
    words = [sys.executable, "-c", program]
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, timeout=limit_s, errors="replace", check=False
        )
    except subprocess.TimeoutExpired:
        return {"error": f"its import did not end in {limit_s:g} s"}
    if done.returncode == 0:
        answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return answer
    said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    why = said[-1] if said else f"exit status {done.returncode}"
    return {"error": f"its import fails: {why}"}


def _free(space: Mapping[str, Any]) -> str:
    return f"{_size(space['free_bytes'])} of {_size(space['total_bytes'])} free"


def _size(count: int) -> str:
    return f"{count / _GIB:.1f} GiB" if count >= _GIB // 10 else f"{count / (1 << 20):.0f} MiB"
