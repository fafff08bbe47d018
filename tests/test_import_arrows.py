"""The packages depend on each other one way only: msgs ◀ edge ◀ sim_replay, msgs ◀ trainer."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def test_the_arrows_hold() -> None:
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "5 kept, 0 broken" in result.stdout


def test_an_arrow_against_the_grain_is_found(tmp_path: Path) -> None:
    """The rule itself works: one wrong import in a copy of msgs and it fails."""
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    for package in ("edge", "msgs", "trainer", "sim_replay"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("import edge\n" if package == "msgs" else "")
    for module in ("data", "sources"):
        (tmp_path / "trainer" / f"{module}.py").touch()
    result = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        env={"PYTHONPATH": str(tmp_path), "PATH": ""},
    )
    assert result.returncode != 0
    assert "msgs -> edge" in result.stdout
