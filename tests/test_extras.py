"""Each command starts with the packages of its own extra alone: the demo needs neither torch nor a renderer."""

import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Stands in for packages that were never installed: the modules named in argv[1] cannot be found.
BLOCKED = """
import sys
missing = set(sys.argv[1].split(","))
class Installed:
    def __init__(self, finders):
        self.finders = finders
    def find_spec(self, name, path=None, target=None):
        found = (finder.find_spec(name, path, target) for finder in self.finders)
        return None if name.split(".")[0] in missing else next(filter(None, found), None)
    def find_distributions(self, context):
        for finder in self.finders:
            yield from getattr(finder, "find_distributions", lambda _: [])(context)
sys.meta_path[:] = [Installed(list(sys.meta_path))]
from importlib import import_module
main = import_module(sys.argv[2]).main
sys.argv[1:] = sys.argv[3:]
sys.exit(main())
"""


def distributions(requirements: list[str]) -> set[str]:
    return {requirement.split("==")[0].lower().replace("_", "-") for requirement in requirements}


def missing_with(extra: str | None) -> set[str]:
    """Top-level modules that the other extras bring and this one does not."""
    extras = PROJECT["optional-dependencies"]
    here = distributions(PROJECT["dependencies"]) | distributions(extras.get(extra, []))
    elsewhere = set().union(*(distributions(named) for named in extras.values())) - here
    return {
        module
        for module, names in packages_distributions().items()
        if {name.lower().replace("_", "-") for name in names} & elsewhere
    }


def run(missing: set[str], *command: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-c", BLOCKED, ",".join(sorted(missing)), *command]
    return subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    ("extra", "command"),
    [
        (None, ("edge.cli", "--help")),
        (None, ("edge.cli", "run", "--help")),
        ("replay", ("sim_replay.launch", "--help")),
        ("replay", ("sim_replay.launch", "demo", "--help")),
        ("replay", ("sim_replay.launch", "radio", "--help")),
        ("ground", ("msgs.ground.cli", "watch", "--help")),
        ("trainer", ("trainer.launch", "--help")),
    ],
)
def test_a_command_starts_with_its_own_packages_alone(extra: str | None, command: tuple[str, ...]) -> None:
    missing = missing_with(extra)
    assert "playwright" in missing
    assert ("torch" in missing) == (extra != "trainer")
    done = run(missing, *command)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


@pytest.mark.parametrize(
    ("extra", "command", "needed"),
    [
        ("replay", ("sim_replay.launch", "radio", "--seconds", "1"), "ground"),
        ("replay", ("sim_replay.launch", "generate", "--preset", "unseen", "--out", "OUT"), "render"),
        (None, ("sim_replay.launch", "demo", "--out", "OUT"), "replay"),
        (None, ("msgs.ground.cli", "watch"), "ground"),
        (None, ("msgs.ground.cli", "keys", "list"), "ground"),
        (None, ("msgs.ground.cli", "view"), "ground"),
        ("replay", ("trainer.cli", "average", "--out", "OUT", "OUT"), "trainer"),
    ],
)
def test_what_needs_another_extra_says_which(
    tmp_path: Path, extra: str | None, command: tuple[str, ...], needed: str
) -> None:
    out = str(tmp_path / "out")
    done = run(missing_with(extra), *(out if word == "OUT" else word for word in command))
    assert done.returncode == 2, done.stderr
    assert f"pip install '.[{needed}]'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("script", sorted(PROJECT["scripts"]))
def test_without_extras_a_command_starts_or_says_which_it_needs(script: str) -> None:
    module, _, _ = PROJECT["scripts"][script].partition(":")
    done = run(missing_with(None), module, "--help")
    needed = f"pip install '.[{script.removeprefix('uavpose-')}]'\n"
    starts = done.returncode == 0 and done.stdout.startswith("usage: ")
    assert starts or (done.returncode == 2 and done.stderr.endswith(needed)), done.stderr


def test_the_bench_times_what_is_there() -> None:
    done = run(missing_with(None), "edge.cli", "bench", "--runs", "1", "--threads", "1")
    assert done.returncode == 0, done.stderr
    assert "the package torch is missing" in done.stderr
    assert "onnxruntime" in done.stdout.lower()
