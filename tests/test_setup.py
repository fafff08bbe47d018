"""Set-up as a stranger meets it where the machine is not as it should be."""

import subprocess
import sys
from pathlib import Path

import pytest

from sim_replay.faults.rig import can_mount

ROOT = Path(__file__).parents[1]
# A checkout on a disk of 20 MB, with a virtual environment that has pip and nothing else made.
ON_A_SMALL_DISK = """
mount -t tmpfs -o size=20m none "$1"
mkdir -p "$1/.venv/bin" && printf '#!/bin/sh\nexec "%s" "$@"\n' "$2" >"$1/.venv/bin/python"
chmod +x "$1/.venv/bin/python"
cp -r "$3/deploy" "$3/pyproject.toml" "$1"
sh "$1/deploy/bootstrap.sh" demo
status=$?
ls -A "$1/.venv"
exit $status
"""


def test_a_disk_too_small_for_the_packages_is_told_before_any_is_fetched(tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this host does not let a user mount a file system (unshare --map-root-user --mount)")
    mounting = ["unshare", "--map-root-user", "--mount", "sh", "-c", ON_A_SMALL_DISK, "sh"]
    done = subprocess.run([*mounting, tmp_path, sys.executable, ROOT], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout.split() == ["bin"]
    assert f"MB are free on the disk of {tmp_path} and the packages for demo need" in done.stderr
