"""The commands as a person meets them: speed on this machine, and what is said when a package is missing."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from sim_replay.cli import main

WITHOUT = """
import sys
sys.modules[{name!r}] = None  # as if it were not installed
from sim_replay.cli import main
sys.exit(main({words!r}))
"""


def test_bench_names_the_machine_and_counts_what_it_drew(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--seconds", "0.2", "--workers", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cpu"]
    assert found["gl_renderer"]
    for kind in ("frames", "windows"):
        rates = found[f"{kind}_per_second"]
        assert len(rates["each_worker"]) == 1
        assert rates["together"] == rates["each_worker"][0] > 0
    # A window is an eightieth of a frame's pixels, so it takes less.
    assert found["windows_per_second"]["together"] > found["frames_per_second"]["together"]


@pytest.mark.parametrize("words", [["--workers", "0"], ["--seconds", "0"], ["--seconds", "nan"], ["--seconds", "inf"]])
def test_bench_refuses_to_measure_nothing(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *words]) == 2
    assert "must be above 0" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["moderngl", "jsbsim", "av"])
def test_a_missing_package_is_named(name: str, tmp_path: object) -> None:
    words = ["generate", "--preset", "stress", "--out", f"{tmp_path}/stress"]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.format(name=name, words=words)], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert f"the package {name} is missing; install the render extra" in done.stderr
    assert "Traceback" not in done.stderr
