"""``fluxvla run`` in this process: sections, work dirs, records, refusals, endings."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.cli.plan import default_work_dir
from fluxvla_core.cli.reporters import KeepAliveReporter
from fluxvla_core.config.load import load_config, write_resolved
from fluxvla_core.config.overrides import apply_overrides
from tests.cli.messages import said
from tests.conftest import Install

from .conftest import TOY, Fluxvla, Write


def test_training(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.max_epochs=2")
    assert (ended.code, ended.err) == (0, "")
    told = said()
    config = told.pop("config")
    assert told == {
        "section": "runner",
        "examples": 3,
        "resume": None,
        "nproc": 1,
        "file": "c.py",
        "epochs": 2,
        "threads": os.environ.get("OMP_NUM_THREADS"),
        "world": None,
        "where": "--set runner.max_epochs=2: runner.max_epochs",
    }
    saved = json.loads(Path("work_dirs/c/config.resolved.json").read_text())
    assert saved["config"] == config
    assert saved["origins"]["runner.max_epochs"] == "--set runner.max_epochs=2"
    environment = json.loads(Path("work_dirs/c/environment.json").read_text())
    assert environment["fluxvla-core"]
    texts = [line.partition("] ")[2] for line in ended.out.splitlines()]
    assert texts == [
        "train 1/2  loss 0.5",
        "train 2/2  loss 0.25",
        "loss: 0.25",
        "steps: 2",
        "work dir: work_dirs/c",
    ]


def test_a_train_runner_of_ones_own_needs_no_torch(write: Write) -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from fluxvla_core.cli.main import main\n"
        "words = 'run --plugin toy.py --config c.py --section runner'\n"
        "sys.exit(main(words.split()))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert said()["examples"] == 3


def test_a_hint_names_the_tables_of_the_config(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode=hints")
    assert ended.code == 2
    assert (
        "next: --set runner.mode=a, --set train_dataloader.dataset.size=2 or --set <Gone>.size=2"
        in ended.err
    )


def test_a_section_that_is_silent_is_said_to_be_working(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(KeepAliveReporter.__init__, "__defaults__", (0.1, "start"))
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode=silent")
    assert ended.code == 0
    assert "s since: train 1/2" in ended.out


def test_what_records_a_robots_run_is_part_of_the_config(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--record", "rec")
    assert ended.code == 2
    assert "--record: runner.record: ToyTrainRunner takes no 'record'" in ended.err
    ended = run("--config", "c.py", "--section", "eval", "--record", "rec")
    assert "ToyEvalRunner takes no 'record'" in ended.err
    assert not Path("work_dirs").exists()


def test_the_resolved_config_of_a_run_runs_again(run: Fluxvla) -> None:
    run("--config", "c.py", "--section", "runner", "--set", "runner.max_epochs=2")
    first = said()
    ended = run(
        "--config",
        "work_dirs/c/config.resolved.json",
        "--section",
        "runner",
        "--work-dir",
        "again",
    )
    assert ended.code == 0, ended.err
    again = said("again")
    assert again["config"] == first["config"]
    assert again["where"] == first["where"]


def test_evaluation(run: Fluxvla) -> None:
    ended = run(
        "--config",
        "c.py",
        "--section",
        "eval",
        "--task",
        "lift it",
        "--nproc",
        "3",
        "--work-dir",
        "out/x",
    )
    assert ended.code == 0, ended.err
    assert Path("out/x/eval.txt").read_text() == "True lift it 3"
    assert Path("out/x/config.resolved.json").exists()


def test_what_is_evaluated_later_leaves_the_trainings_records_alone(run: Fluxvla) -> None:
    run("--config", "c.py", "--section", "runner")
    before = Path("work_dirs/c/config.resolved.json").read_text()
    run("--config", "c.py", "--section", "eval", "--set", "eval.seeds+=9")
    assert Path("work_dirs/c/config.resolved.json").read_text() == before
    theirs = json.loads(Path("work_dirs/c/eval/config.resolved.json").read_text())
    assert theirs["config"]["eval"]["seeds"] == 9
    assert Path("work_dirs/c/eval/environment.json").exists()


def test_the_resolved_config_of_what_was_evaluated_later_runs_in_the_same_work_dir(
    run: Fluxvla,
) -> None:
    run("--config", "c.py", "--section", "runner")
    run("--config", "c.py", "--section", "eval")
    evaluated = Path("work_dirs/c/eval.txt")
    evaluated.unlink()
    resolved = Path("work_dirs/c/eval/config.resolved.json")
    before = resolved.read_text()
    ended = run("--config", str(resolved), "--section", "eval")
    assert ended.code == 0, ended.err
    assert evaluated.exists()
    assert resolved.read_text() == before
    assert sorted(path.name for path in resolved.parent.iterdir()) == [
        "config.resolved.json",
        "environment.json",
    ]


def test_json_lines(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--log-format", "json")
    records = [json.loads(line) for line in ended.out.splitlines()]
    assert [r["kind"] for r in records] == [
        "start",
        "progress",
        "progress",
        "info",
        "info",
        "result",
        "artifact",
    ]
    assert all(isinstance(r.pop("time"), float) for r in records)
    assert records[0] == {"kind": "start", "section": "runner", "work_dir": "work_dirs/c"}
    assert records[2] == {"kind": "progress", "name": "train", "done": 2, "total": 2, "loss": 0.25}
    assert records[5]["result"] == {"loss": 0.25, "steps": 2, "curve": [0.5, 0.25]}


def test_json_lines_of_a_failure(run: Fluxvla) -> None:
    ended = run(
        "--config",
        "c.py",
        "--section",
        "runner",
        "--log-format",
        "json",
        "--set",
        "runner.mode+=denied",
    )
    last = json.loads(ended.out.splitlines()[-1])
    assert (last["kind"], last["type"]) == ("error", "DataError")
    assert last["text"] == "a.mp4: bad data\n  next: look at it"


def test_one_section_is_the_default(run: Fluxvla, write: Write) -> None:
    write("d.py", "eval = dict(type='ToyEvalRunner')\nnote = dict(a=1)\n")
    assert run("--config", "d.py").code == 0
    assert Path("work_dirs/d/eval.txt").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            (),
            "c.py: several sections can be run: runner (ToyTrainRunner), eval (ToyEvalRunner)\n"
            "  next: name one: --section runner",
        ),
        (
            ("--section", "evl"),
            "c.py: no section 'evl'; did you mean 'eval'?\n"
            "  next: sections there: runner (ToyTrainRunner), eval (ToyEvalRunner)",
        ),
        (("--section", "zzz"), "c.py: no section 'zzz'\n"),
        (
            ("--section", "train_dataloader"),
            "c.py: section 'train_dataloader' cannot be run: it is not a table whose type is a "
            "runner",
        ),
    ],
)
def test_sections_that_cannot_be_chosen(run: Fluxvla, words: tuple[str, ...], text: str) -> None:
    ended = run("--config", "c.py", *words)
    assert ended.code == 2
    assert text in ended.err
    assert not Path("work_dirs").exists()


def test_nothing_to_run(run: Fluxvla, write: Write) -> None:
    write("d.py", "x = 1\n")
    ended = run("--config", "d.py")
    assert ended.code == 2
    assert "d.py: nothing to run: no table at the top has a type that is a runner" in ended.err
    ended = run("--config", "d.py", "--section", "runner")
    assert "no section 'runner'\n  next: sections there: none" in ended.err
    write("e.py", "spare = dict(type='ToyEvalRuner')\n")
    ended = run("--config", "e.py")
    assert "spare.type: no plugin named 'ToyEvalRuner' in any registry" in ended.err


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (
            "DeepSpeedTrainRunner",
            "no plugin named 'DeepSpeedTrainRunner'; fluxvla-deepspeed provides it and is not "
            "installed: pip install fluxvla-deepspeed",
        ),
        ("ToyTrainRuner", "no plugin named 'ToyTrainRuner' in any registry; did you mean 'ToyTrai"),
    ],
)
def test_a_section_whose_runner_is_not_there(
    run: Fluxvla,
    write: Write,
    install: Install,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    text: str,
) -> None:
    monkeypatch.setenv("FLUXVLA_PLUGINS", "toy")
    install("fluxvla-toy")
    config = Path("c.py").read_text().replace("'ToyEvalRunner'", "'FarEvalRunner'")
    write("d.py", config + f"finetune = dict(type='{kind}')\n")
    ended = run("--config", "d.py", "--section", "finetune")
    assert ended.code == 2
    assert ended.err.startswith(f"1 problem in the config:\n  d.py:5: finetune.type: {text}")
    assert ended.err.endswith("next: fluxvla plugins list\n")


def test_a_dry_run_builds_nothing(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--dry-run", "--nproc", "2")
    assert ended.code == 0
    assert ended.out.startswith(
        "section: runner (trains)\n"
        "work dir: work_dirs/c\n"
        "plugins:\n"
        "  train_dataloader.dataset  ToyDataset      registered in this process\n"
    )
    assert "  runner.max_epochs = 1" in ended.out
    assert ended.out.rstrip().endswith("# c.py:4")
    assert not Path("work_dirs").exists()


def test_a_dry_run_for_machines(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "eval", "--dry-run", "--log-format", "json")
    outline = json.loads(ended.out)
    assert (outline["section"], outline["trains"]) == ("eval", False)
    assert outline["origins"]["runner.max_epochs"] == "c.py:3"
    assert {
        "key": "eval",
        "type": "ToyEvalRunner",
        "provided_by": "registered in this process",
    } in (outline["plugins"])


@pytest.mark.parametrize(
    ("file", "folder"),
    [
        ("configs/x.py", "work_dirs/x"),
        ("y.toml", "work_dirs/y"),
        ("out/run/config.resolved.json", "out/run"),
        ("out/run/checkpoints/step-000000001/config.resolved.json", "out/run"),
        ("out/eval/config.resolved.json", "out/eval"),
        ("trained/eval/config.resolved.json", "trained"),
        ("trained/other/config.resolved.json", "trained/other"),
        ("exported/config.resolved.json", "work_dirs/exported"),
        ("other.json", "work_dirs/other"),
    ],
)
def test_default_work_dirs(write: Write, file: str, folder: str) -> None:
    write("trained/config.resolved.json", "{}")
    write("exported/manifest.json", "{}")
    assert default_work_dir(Path(file), ["eval", "inference"]) == Path(folder)


@pytest.mark.parametrize(
    ("words", "taken"),
    [
        ((), "out/checkpoints/step-000000003"),
        (("--set", "eval.ckpt_path=mine"), "mine"),
    ],
)
def test_the_config_of_a_checkpoint_means_that_checkpoint(
    run: Fluxvla, write: Write, words: tuple[str, ...], taken: str
) -> None:
    folder = "out/checkpoints/step-000000003"
    toy = TOY.replace("seeds=1, workers", "seeds=1, ckpt_path=None, workers")
    write(
        "toy.py", toy.replace("{self.context.nproc}", "{self.context.config['eval']['ckpt_path']}")
    )
    config = apply_overrides(load_config("c.py"), ["eval.ckpt_path+=another"])
    write(f"{folder}/manifest.json", "{}")
    write_resolved(Path(folder, "config.resolved.json"), config)
    ended = run("--config", f"{folder}/config.resolved.json", "--section", "eval", *words)
    assert ended.code == 0, ended.err
    assert Path("out/eval.txt").read_text().split()[-1] == taken
