"""Which commit counts as released, what is unpacked of it, and which endings are failures."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tools import skew_check
from tools.envs import Env
from tools.shell import StepFailed
from tools.skew_check import Pair, Skewed


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Two commits of a core and a plugin; the second changes both."""
    root = tmp_path / "repository"
    for path in ("", "plugins/fluxvla-latency"):
        (root / path / "src").mkdir(parents=True)
    for version in ("1", "2"):
        for path in ("pyproject.toml", "README.md", "LICENSE", "src/a.py", "plugins/b.toml"):
            (root / path).write_text(version)
        (root / "secret").write_text(version)
        if version == "1":
            git(root, "init", "-q")
        git(root, "add", "-A")
        git(root, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "-m", version)
    return root


def git(root: Path, *words: str) -> str:
    run = ["git", "-C", str(root), *words]
    return subprocess.run(run, check=True, capture_output=True, text=True).stdout.strip()


def test_the_newest_tag_counts_and_without_one_what_is_given(repository: Path) -> None:
    first, second = git(repository, "rev-parse", "HEAD~1"), git(repository, "rev-parse", "HEAD")
    assert skew_check.released(repository, first[:7]) == first
    git(repository, "tag", "v0.9.0", second)
    git(repository, "tag", "v0.10.0", first)
    assert skew_check.released(repository, second) == first  # 10 is newer than 9
    assert skew_check.released(repository, first, second) == second


def test_a_commit_that_is_not_here_is_told(repository: Path) -> None:
    with pytest.raises(Skewed, match=r"0123abc counts as released.*nox -s skew -- COMMIT"):
        skew_check.released(repository, "0123abc")


def test_the_sources_of_that_commit_are_unpacked(repository: Path, tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    (place / "of_before").touch()
    skew_check.unpack(repository, git(repository, "rev-parse", "HEAD~1"), place)
    assert (place / "src" / "a.py").read_text() == "1"
    assert sorted(path.name for path in place.iterdir()) == sorted(
        [*skew_check.SOURCES[:4], "plugins"]
    )


class Fake:
    """An environment in which pip and the kits end as a test says."""

    def __init__(self, install: str = "", kit: tuple[int, str] = (0, "")) -> None:
        self._install, self._kit = install, kit
        self.asked: list[tuple[str, ...]] = []

    def create(self) -> None:
        """Nothing is there."""

    def pip_install(self, *words: str, **options: object) -> None:
        if self._install:
            raise StepFailed(["pip"], 1, self._install)

    def run(self, *words: str, **options: object) -> None:
        self.asked.append(words)
        if self._kit[0]:
            raise StepFailed(words, *self._kit)


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def run(fake: Fake, what: str = "check") -> str:
        monkeypatch.setattr(skew_check, "Env", lambda root: fake)
        monkeypatch.setattr(
            skew_check, "build", lambda root, names, *more: {n: Path(f"{n}.whl") for n in names}
        )
        builder = Env(tmp_path)
        root = Path(__file__).parents[2]
        return getattr(skew_check, what)(Pair("a pair", root, root), tmp_path, builder)

    monkeypatch.setattr(skew_check.rendering, "ensure", lambda env, log: None)
    monkeypatch.setattr(
        skew_check.wheels, "build", lambda dists, *more: {d.name: Path("x.whl") for d in dists}
    )
    return run


def test_kits_that_pass(check) -> None:
    fake = Fake()
    assert check(fake) == "a pair: the kits of fluxvla-latency, fluxvla-sim pass"
    assert [words[3] for words in fake.asked] == ["LatencyLog", "AlohaSimOperator"]


def test_bounds_that_exclude_the_core_are_no_failure(check) -> None:
    said = "ERROR: Cannot install ... conflicting dependencies: it depends on fluxvla-core<0.2"
    assert check(Fake(said)) == "a pair: pip says that they do not fit"


@pytest.mark.parametrize(
    ("fake", "told"),
    [
        (Fake("no space left on the disk"), "pip cannot install it"),
        (Fake(kit=(1, "FAILED is complete")), "the kit of LatencyLog fails:\nFAILED is complete"),
        (Fake(kit=(2, "is written for hooks 2.0")), "pip takes them together, and the kit of"),
    ],
)
def test_what_pip_takes_has_to_work(check, fake: Fake, told: str) -> None:
    with pytest.raises(Skewed) as caught:
        check(fake)
    assert told in str(caught.value)


def test_another_version_of_the_contract_is_refused_in_words(check) -> None:
    words = "fluxvla: LatencyLog is written for hooks 9.0,\n this core speaks 1.0"
    assert check(Fake(kit=(2, words)), "check_refusal").endswith("is refused in words")
    for fake, told in (
        (Fake(), "is taken as if it fitted"),
        (Fake(kit=(1, "Traceback: AttributeError")), "ends with:\nTraceback"),
        (Fake(kit=(1, words)), "ends with:"),
    ):
        with pytest.raises(Skewed, match=told):
            check(fake, "check_refusal")
