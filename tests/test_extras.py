"""Each command starts with the packages of its own extra alone: the demo needs neither torch nor a renderer."""

import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
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
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    here = distributions(project["dependencies"]) | distributions(extras.get(extra, []))
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
        ("replay", ("sim_replay.cli", "--help")),
        ("replay", ("sim_replay.cli", "demo", "--help")),
        ("replay", ("sim_replay.cli", "radio", "--help")),
        ("ground", ("msgs.ground.cli", "watch", "--help")),
    ],
)
def test_a_command_starts_with_its_own_packages_alone(extra: str | None, command: tuple[str, ...]) -> None:
    missing = missing_with(extra)
    assert {"torch", "playwright"} <= missing
    done = run(missing, *command)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")


def test_what_needs_another_extra_says_which(tmp_path: Path) -> None:
    done = run(missing_with("replay"), "sim_replay.cli", "radio", "--seconds", "1")
    assert done.returncode == 2
    assert "pip install '.[ground]'" in done.stderr
    done = run(missing_with("replay"), "sim_replay.cli", "generate", "--preset", "unseen", "--out", str(tmp_path / "d"))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
