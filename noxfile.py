"""The commands of users and of CI.

    nox -s demo [-- --smoke | --full] [--fresh]     from demonstrations to an evaluated policy
    nox -s tests [-- PYTEST ARGUMENTS]              everything that CI checks
    nox -s nightly [-- PYTEST ARGUMENTS]            the slow tests, then docs, skew and py313
    nox -s oracles                                  the references in golden files, computed again
    nox -s skew [-- COMMIT]                         the released core with current plugins, and back
    nox -s py313 [-- PYTEST ARGUMENTS]              the tests without torch, on Python 3.13
    nox -s lint | types | layers                    one part of the tests
    nox -s bench [-- NAME]                          the benchmarks
    nox -s docs [-- serve]                          the documentation as a site, in site/

Everything a session needs is installed by the session, into .nox/ and dist/ of this checkout.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import nox

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT))

from tools import (  # noqa: E402
    envs,
    golden,
    lerobot_env,
    needs,
    oracle_env,
    project,
    pythons,
    rendering,
    shell,
    skew_check,
    stages,
    torch_build,
    unseen,
    wheels,
)
from tools.demo import __main__ as demo_program  # noqa: E402
from tools.demo import next_steps  # noqa: E402
from tools.steps import Steps  # noqa: E402

nox.needs_version = ">=2024.4.15"
nox.options.sessions = ["tests"]
nox.options.default_venv_backend = "none"

EXTRAS = "data,train"
TESTED_EXTRAS = f"{EXTRAS},record,lora,tensorboard,trackio,wandb"
# Extras of plugins that some Pythons and platforms cannot have: their tests are skipped there.
OPTIONAL = {
    "fluxvla-deepspeed": "deepspeed",
    "fluxvla-libero": "libero",
    "fluxvla-metaworld": "metaworld",
}
# Counts as released until there is a tag v...: the state at which the contracts were 1.0.
RELEASED = "bac7408"
SKIPPED = ROOT / ".nox" / "skipped.jsonl"
LATER = ROOT / ".nox" / "later.json"
# One more than the cores of a small machine: a test that starts processes waits for them.
PROCESSES = os.environ.get("FLUXVLA_TEST_PROCESSES", "3")
SLOWEST = "--durations=15"
# Files share what is slow to make; what waits for networks is in few files, of unequal length.
# The order is that of the root conftest: what is marked 'early', then the files of many tests.
ORDER = ["--no-loadscope-reorder", SLOWEST]
FILES, TURNS = ["--dist", "loadfile", *ORDER], ["--dist", "loadgroup", *ORDER]
STAGES = {
    "pytest": ["-n", PROCESSES, *FILES, "-m", "not network and not realtime and not slow"],
    "pytest, over networks": ["-n", "3", *TURNS, "-m", "network and not realtime and not slow"],
    "pytest, in real time": ["-n", "2", *FILES, "-m", "realtime and not alone and not slow"],
    "pytest, alone": [SLOWEST, "-m", "alone and not slow"],
}
# Stage -> the mark of its tests, by which the first stage notes the files they are in.
MARKS = {
    "pytest, over networks": "network",
    "pytest, in real time": "realtime",
    "pytest, alone": "alone",
}


@nox.session
def tests(session: nox.Session) -> None:
    """Lint, types, layers, all tests with the packaging ones, and the demo's short form."""
    with Steps(session) as step:
        if session.posargs:
            dev = dev_env(session)
            make_renderable(session, dev)
            step("pytest", lambda: dev.run("pytest", *session.posargs, env=rendering.VARIABLES))
            return
        ensure_needs(session)
        for noted in (SKIPPED, LATER):
            noted.unlink(missing_ok=True)
        # pip and mypy use one core each.
        with shell.alongside([sys.executable, "-m", "nox", "-s", "environments"], cwd=ROOT):
            dev = dev_env(session)
            step("lint", lambda: check_lint(dev))
            step("types", lambda: dev.run("mypy", cwd=ROOT))
            step("layers", lambda: dev.run("lint-imports", cwd=ROOT))
        make_renderable(session, dev)
        for name in STAGES:
            step(name, lambda n=name: run_stage(dev, n))
        step("demo --smoke", lambda: run_demo(session, ["--smoke", "--fresh"]))
        step("next steps named by the demo", lambda: check_next_steps(session))
        step("a third party's plugin in the demo's environment", lambda: check_third_party(session))
        step("skipped tests", lambda: print(*stages.summary(SKIPPED), sep="\n"))


@nox.session
def nightly(session: nox.Session) -> None:
    """The tests that take minutes each; without arguments then docs, skew and py313."""
    if not session.posargs:
        for name in ("docs", "skew", "py313"):
            session.notify(name)
    with Steps(session) as step:
        dev = dev_env(session)
        make_renderable(session, dev)
        words = ["-m", "slow", *session.posargs]
        step("pytest", lambda: dev.run("pytest", *words, cwd=ROOT, env=rendering.VARIABLES))


@nox.session
def environments(session: nox.Session) -> None:
    """Environments of the tests besides .nox/dev: LeRobot's, to compare with, and the demo's."""
    with Steps(session) as step:
        step("LeRobot", lambda: lerobot_env.prepare(session.log))
        step("LeRobot's policies", lambda: oracle_env.prepare_044(session.log))
        step("demo", lambda: demo_env(session))


@nox.session
def oracles(session: nox.Session) -> None:
    """Compute the golden files again with LeRobot, and compare.

    Programs for other references are run by hand (CONTRIBUTING.md, "Golden files"), and are listed.
    Also runs the tests of fluxvla-lerobot that need LeRobot.
    """
    with Steps(session) as step:
        made: dict[Path, Path] = {}
        by_hand = [p for p in golden.programs(ROOT) if p.environment is None]
        for program in by_hand:
            session.log(f"run by hand, as it says: {program.path.relative_to(ROOT)}")
        alone = oracle_env.VARIABLES
        with tempfile.TemporaryDirectory() as temporary:
            for program in golden.programs(ROOT):
                if program.environment is None:
                    continue
                env = oracle_env.ENVIRONMENTS[program.environment](session.log)
                folder = Path(temporary) / program.golden.parent.parent.name
                folder.mkdir(exist_ok=True)
                made[program.golden] = folder
                words = [program.path, folder]
                name = program.path.relative_to(ROOT).as_posix()
                step(name, lambda e=env, w=words: e.run("python", *w, cwd=ROOT, env=alone))
            env = oracle_env.prepare(session.log)
            for committed, folder in made.items():
                some = ["--some"] if committed in {p.golden for p in by_hand} else []
                words = ["-m", "tools.golden", folder, committed, *some]
                name = f"compare {committed.relative_to(ROOT).as_posix()}"
                step(name, lambda e=env, w=words: e.run("python", *w, cwd=ROOT))
        dev = dev_env(session)
        make_renderable(session, dev)
        both = envs.join(env, dev)
        words = ["-m", "pytest", ROOT / "plugins" / "fluxvla-lerobot" / "tests" / "with_lerobot"]
        variables = {**rendering.VARIABLES, **alone}
        step("fluxvla-lerobot", lambda: both.run("python", *words, cwd=ROOT, env=variables))


@nox.session
def skew(session: nox.Session) -> None:
    """The released core with current plugins, and released plugins with the current core."""
    place = ROOT / ".nox" / "skew"
    with Steps(session) as step:
        builder = wheels.builder_env(ROOT / ".nox" / "build", project.CONSTRAINTS)
        commit = skew_check.released(ROOT, RELEASED, *session.posargs[:1])
        before = skew_check.unpack(ROOT, commit, place / "released")
        pairs = (
            skew_check.Pair(f"core of {commit[:7]}, plugins at head", before, ROOT),
            skew_check.Pair(f"core at head, plugins of {commit[:7]}", ROOT, before),
        )
        for number, pair in enumerate(pairs):
            folder = place / str(number)
            for check in (skew_check.check, skew_check.check_refusal):
                words = (pair, folder, builder)
                step(f"{check.__name__}: {pair.name}", lambda c=check, w=words: print(c(*w)))


@nox.session
def py313(session: nox.Session) -> None:
    """The tests without torch, on Python 3.13: commands, configs, robots, evaluation, kits."""
    with Steps(session) as step:
        pyproject = nox.project.load_toml(ROOT / "pyproject.toml")
        env = pythons.filled(ROOT, nox.project.dependency_groups(pyproject, "dev"), session.log)
        words = session.posargs or ["-n", PROCESSES, *FILES, *pythons.TESTED]
        step("pytest", lambda: env.run("pytest", *words, cwd=ROOT, env=rendering.VARIABLES))


@nox.session
def demo(session: nox.Session) -> None:
    """Collect, train, evaluate and run a policy for the simulated ALOHA; one HTML report."""
    with Steps(session) as step:
        step("demo", lambda: run_demo(session, session.posargs))


@nox.session
def lint(session: nox.Session) -> None:
    """ruff check and ruff format --check."""
    with Steps(session) as step:
        dev = dev_env(session)
        step("lint", lambda: check_lint(dev))


@nox.session
def types(session: nox.Session) -> None:
    """mypy, strict, on the core."""
    with Steps(session) as step:
        dev = dev_env(session)
        step("types", lambda: dev.run("mypy", *session.posargs, cwd=ROOT))


@nox.session
def layers(session: nox.Session) -> None:
    """import-linter: which package of the core may import which."""
    with Steps(session) as step:
        dev = dev_env(session)
        step("layers", lambda: dev.run("lint-imports", *session.posargs, cwd=ROOT))


@nox.session
def docs(session: nox.Session) -> None:
    """The documentation as a site, in site/, without a dead link; ``-- serve`` shows it."""
    with Steps(session) as step:
        env = docs_env(session)
        words = ["-m", "tools.docs", *session.posargs]
        step("docs", lambda: env.run("python", *words, cwd=ROOT))


@nox.session
def bench(session: nox.Session) -> None:
    """Every benchmark of benchmarks/, or those named; results go to benchmarks/results/."""
    with Steps(session) as step:
        dev = dev_env(session)
        make_renderable(session, dev)
        named = session.posargs or sorted(p.stem for p in (ROOT / "benchmarks").glob("[!_]*.py"))
        for name in named:
            words = ["-m", f"benchmarks.{name}"]
            step(name, lambda w=words: dev.run("python", *w, cwd=ROOT, env=rendering.VARIABLES))


def run_stage(dev: envs.Env, name: str) -> None:
    """One call of pytest; the first stage lists the files with tests of the other stages."""
    variables = {**rendering.VARIABLES, stages.SKIPPED: str(SKIPPED)}
    files: list[str] = []
    if name in MARKS:
        files = stages.files(LATER, MARKS[name])
    else:
        variables[stages.FILE] = str(LATER)
    dev.run("pytest", *STAGES[name], *files, cwd=ROOT, env=variables)


def check_lint(dev: envs.Env) -> None:
    dev.run("ruff", "check", ".", cwd=ROOT)
    dev.run("ruff", "format", "--check", ".", cwd=ROOT)


def dev_env(session: nox.Session) -> envs.Env:
    """.nox/dev: torch, the tools, and core and plugins in editable mode."""
    env = envs.Env(ROOT / ".nox" / "dev")
    dists = project.distributions(ROOT)
    pyproject = nox.project.load_toml(ROOT / "pyproject.toml")
    needs = nox.project.dependency_groups(pyproject, "dev")
    extras = {extra: requirements_of(dists, dist, extra) for dist, extra in OPTIONAL.items()}

    def install(changed: list[str], fresh: bool) -> None:
        words: list[str] = []
        for dist in (d for d in dists if d.name in changed):
            tested = f"[{TESTED_EXTRAS}]" if dist.path == ROOT else ""
            words += ["-e", f"{dist.path}{tested}"]
        session.log(f"installing in editable mode: {', '.join(changed)}")
        env.pip_install("--no-build-isolation", *words, constraints=project.CONSTRAINTS)
        add_model_files(env)

    # Sources are used in place; only what an installation reads makes it out of date.
    parts = {d.name: project.digest([d.path / "pyproject.toml"], relative_to=d.path) for d in dists}

    def base() -> None:
        install_base(session, env, needs)
        install_ros2(session, env, pyproject["project"]["optional-dependencies"]["ros2"])
        for extra, requirements in extras.items():
            install_optional(session, env, extra, requirements)
        # Robosuite asks for the OpenCV with windows; it lies in the files of the headless one,
        # which the core brings, and needs a desktop's libraries to be imported.
        env.run("python", "-m", "pip", "uninstall", "--yes", "--quiet", "opencv-python")

    env.filled(base_of((*needs, *sum(extras.values(), ()))), parts, base, install)
    return env


def docs_env(session: nox.Session) -> envs.Env:
    """.nox/docs: mkdocs and its plugins, and the core's dependencies."""
    env = envs.Env(ROOT / ".nox" / "docs")
    pyproject = nox.project.load_toml(ROOT / "pyproject.toml")
    needs = nox.project.dependency_groups(pyproject, "docs")
    needs = (*needs, *pyproject["project"]["dependencies"])

    def install() -> None:
        session.log(f"installing {len(needs)} packages and their dependencies")
        env.pip_install(*needs, constraints=project.CONSTRAINTS)

    env.filled(base_of(needs), {}, install, lambda changed, fresh: None)
    return env


def demo_env(session: nox.Session) -> tuple[envs.Env, str]:
    """.nox/demo: torch and the wheels of core and plugins; and a digest of their code."""
    env = envs.Env(ROOT / ".nox" / "demo")
    dists = project.distributions(ROOT)
    built: dict[str, Path] = {}

    def install(changed: list[str], fresh: bool) -> None:
        builder = wheels.builder_env(ROOT / ".nox" / "build", project.CONSTRAINTS)
        built.update(wheels.build(dists, ROOT / "dist", builder))
        session.log(f"installing wheels: {', '.join(changed)}")
        core = dists[0].name
        named = [f"{path}[{EXTRAS}]" if name == core else path for name, path in built.items()]
        env.pip_install(*named, constraints=project.CONSTRAINTS)
        if not fresh:  # same version, other content: pip would keep what is there
            again = ["--force-reinstall", "--no-deps", *(built[name] for name in changed)]
            env.pip_install(*again, constraints=project.CONSTRAINTS)
        add_model_files(env)

    parts = {d.name: d.fingerprint() for d in dists}
    env.filled(base_of(()), parts, lambda: install_base(session, env, ()), install)
    make_renderable(session, env)
    return env, project.combined(parts)


def base_of(requirements: tuple[str, ...]) -> dict[str, str]:
    return {
        "python": sys.version,
        "constraints": project.CONSTRAINTS.read_text(encoding="utf-8"),
        "gpu": str(torch_build.nvidia_gpus() > 0),
        "requirements": " ".join(requirements),
    }


def install_base(session: nox.Session, env: envs.Env, requirements: tuple[str, ...]) -> None:
    version = project.constrained_version("torch")
    session.log(f"installing torch {version} into {env.root.relative_to(ROOT)}")
    way = torch_build.install(env, version, project.CONSTRAINTS, session.log)
    session.log(f"torch came by way of: {way}")
    if requirements:
        session.log(f"installing {len(requirements)} tools and their dependencies")
        env.pip_install(*requirements, constraints=project.CONSTRAINTS)


def add_model_files(env: envs.Env) -> None:
    """The ALOHA's model files without the simulator around them; pyproject of fluxvla-sim: why."""
    if sys.version_info >= (3, 13):
        env.pip_install("--no-deps", "gym-aloha", constraints=project.CONSTRAINTS)


def install_ros2(session: nox.Session, env: envs.Env, requirements: list[str]) -> None:
    """rclpy and its messages as wheels, where there are any: without, its tests are skipped."""
    try:
        env.pip_install(*requirements, constraints=project.CONSTRAINTS)
    except shell.StepFailed as error:
        session.warn(f"no ROS 2 for this Python and platform, its tests are skipped: {error}")


def requirements_of(dists: list[project.Distribution], dist: str, extra: str) -> tuple[str, ...]:
    (path,) = (d.path for d in dists if d.name == dist)
    found = nox.project.load_toml(path / "pyproject.toml")
    return tuple(found["project"]["optional-dependencies"][extra])


def install_optional(
    session: nox.Session, env: envs.Env, name: str, requirements: tuple[str, ...]
) -> None:
    session.log(f"installing {name}")
    try:
        env.pip_install(*requirements, constraints=project.CONSTRAINTS)
    except shell.StepFailed as error:
        session.warn(f"no {name} for this Python and platform, its tests are skipped: {error}")


def ensure_needs(session: nox.Session) -> None:
    try:
        needs.ensure(session.log)
    except needs.Lacking as error:
        print(error, file=sys.stderr)
        sys.exit(2)  # bad surroundings, as below


def make_renderable(session: nox.Session, env: envs.Env) -> None:
    try:
        rendering.ensure(env, session.log)
    except rendering.CannotRender as error:
        print(error, file=sys.stderr)
        # nox would turn a session's error into 1; this one is 'bad surroundings', as the CLI's 2.
        sys.exit(2)


def run_demo(session: nox.Session, arguments: list[str]) -> None:
    demo_program.parser().parse_args(arguments)  # refuse bad arguments before installing anything
    began = time.monotonic()
    env, build = demo_env(session)
    words = ["--build", build, "--installed-in", f"{time.monotonic() - began:.1f}", *arguments]
    env.run("python", "-m", "tools.demo", *words, cwd=ROOT, env=rendering.VARIABLES)


def check_next_steps(session: nox.Session) -> None:
    env, _ = demo_env(session)
    next_steps.check(env, ROOT, Path("demo_out"))


def check_third_party(session: nox.Session) -> None:
    env, _ = demo_env(session)
    builder = wheels.builder_env(ROOT / ".nox" / "build", project.CONSTRAINTS)
    unseen.check(env, builder, ROOT / ".nox" / "stranger")
