"""Set-up as a stranger meets it where the machine is not as it should be."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sim_replay.faults.rig import can_mount

ROOT = Path(__file__).parents[1]
# A checkout on a small disk, with a virtual environment that has pip and nothing else made.
ON_A_SMALL_DISK = """
mount -t tmpfs -o size="$5" none "$1"
mkdir -p "$1/.venv/bin" && printf '#!/bin/sh\nexec "%s" "$@"\n' "$2" >"$1/.venv/bin/python"
chmod +x "$1/.venv/bin/python"
cp -r "$3/deploy" "$3/pyproject.toml" "$1"
sh "$1/deploy/bootstrap.sh" "$4"
status=$?
ls -A "$1/.venv"
exit $status
"""


def set_up(folder: Path) -> subprocess.CompletedProcess[str]:
    """What bootstrap says, called as make does by a user whose `cd` looks elsewhere first; pip finds no package, so
    nothing is downloaded."""
    elsewhere = folder.parent / "elsewhere"
    (elsewhere / "deploy").mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "CDPATH": str(elsewhere), "PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull}
    for variable in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL", "PIP_INDEX_URL"):
        environment.pop(variable, None)
    command = ["sh", "deploy/bootstrap.sh", "demo"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment)


def checkout(folder: Path) -> Path:
    """What bootstrap reads of a checkout."""
    shutil.copytree(ROOT / "deploy", folder / "deploy")
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def test_a_copied_checkout_does_not_run_the_code_of_the_original(tmp_path: Path) -> None:
    original, copied = checkout(tmp_path / "original"), tmp_path / "a copy"
    assert "making .venv" in set_up(original).stderr
    assert "making .venv" not in set_up(original).stderr
    shutil.copytree(original, copied, symlinks=True)
    assert "making .venv" in set_up(copied).stderr
    assert str(original) not in (copied / ".venv" / "bin" / "pip").read_text()
    assert "making .venv" not in set_up(copied).stderr


def test_packages_are_installed_again_where_an_upgrade_of_the_system_brought_another_python(tmp_path: Path) -> None:
    folder = checkout(tmp_path / "checkout")
    python = folder / ".venv" / "bin" / "python"  # one whose packages are in a folder of the Python before
    python.parent.mkdir(parents=True)
    python.symlink_to("/bin/false")
    content = (folder / "pyproject.toml").read_bytes() + (folder / "deploy" / "constraints.txt").read_bytes()
    (folder / ".venv" / f".demo-{hashlib.sha256(content).hexdigest()[:16]}").touch()
    done = set_up(folder)
    assert "installing Python packages for demo" in done.stderr
    assert done.returncode != 0


def set_up_on_a_disk(folder: Path, size: str, use: str, python: str) -> subprocess.CompletedProcess[str]:
    if not can_mount(folder):
        pytest.skip("this host does not let a user mount a file system (unshare --map-root-user --mount)")
    mounting = ["unshare", "--map-root-user", "--mount", "sh", "-c", ON_A_SMALL_DISK, "sh"]
    return subprocess.run([*mounting, folder, python, ROOT, use, size], capture_output=True, text=True)


def test_a_disk_too_small_for_the_packages_is_told_before_any_is_fetched(tmp_path: Path) -> None:
    done = set_up_on_a_disk(tmp_path, "20m", "demo", sys.executable)
    assert done.returncode == 2
    assert done.stdout.split() == ["bin"]
    assert f"MB are free on the disk of {tmp_path} and the packages for demo need" in done.stderr


@pytest.mark.parametrize(("size", "enough"), [("5g", False), ("8g", True)])
def test_a_disk_too_small_for_cuda_builds_is_told_of_before_any_is_fetched(
    size: str, enough: bool, tmp_path: Path
) -> None:
    done = set_up_on_a_disk(tmp_path, size, "dev", "/bin/true")  # which installs nothing
    assert done.returncode == 0
    told = (
        f"MB are free on the disk of {tmp_path}: too few if pip's index offers CUDA builds of torch (see README.md)\n"
    )
    assert (told in done.stderr) is not enough
