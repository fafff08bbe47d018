"""docs/ground.md says what is so: its table is the code's, its files load, its commands parse."""

from __future__ import annotations

import ast
import builtins
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from edge.config import load_config
from msgs.ground import cli
from msgs.ground.keys import init_authority, issue
from msgs.ground.router import load_router
from msgs.topics import table_markdown

TEXT = (Path(__file__).parents[3] / "docs" / "ground.md").read_text()
BLOCKS = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = re.findall(r"^    uavpose-ground (.*?)(?:\s*[#|].*)?$", TEXT, re.MULTILINE)


def test_the_table_of_topics_is_current() -> None:
    between = re.search(r"<!-- topics: written.*?-->\n(.*?)<!-- topics: end -->", TEXT, re.DOTALL)
    assert between is not None
    assert between[1].strip() == table_markdown().strip()


def test_the_router_s_file_loads(tmp_path: Path) -> None:
    (router,) = (block for block in BLOCKS if "[access]" in block)
    path = tmp_path / "router.toml"
    path.write_text(router)
    settings = load_router(path)
    assert settings.access is not None
    assert set(tomllib.loads(router)["access"]) == set(type(settings.access).model_fields)


def test_the_vehicle_s_files_load(tmp_path: Path) -> None:
    init_authority(tmp_path / "keys")
    issue(tmp_path / "keys", "uav1")
    blocks = [block for block in BLOCKS if "[access]" not in block]
    path = tmp_path / "flight.toml"
    path.write_text('[camera]\ntype = "sequence"\npath = "scene"\n' + "".join(blocks))
    config = load_config(path).config
    assert config.zenoh.tls is not None
    assert config.recorder.enabled


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_parses(command: str) -> None:
    assert callable(cli._parser().parse_args(shlex.split(command)).act)


def test_the_kinds_of_lines_that_watch_prints_are_the_same_in_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["watch", "--help"])
    told = re.search(r"one JSON object per line: ([a-z, \n]+)", capsys.readouterr().out)
    between = re.search(r"\| `type` \| keys.*?\n\n", TEXT, re.DOTALL)
    assert told is not None
    assert between is not None
    assert re.findall(r"\w+", told[1]) == re.findall(r"^\| `(\w+)` \| (?!keys)", between[0], re.MULTILINE)


@pytest.mark.parametrize("program", re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL))
def test_each_program_imports_what_it_uses(program: str) -> None:
    nodes = list(ast.walk(ast.parse(program)))
    used = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    there = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    there |= {alias.name for node in nodes if isinstance(node, ast.Import | ast.ImportFrom) for alias in node.names}
    assert used <= there | set(dir(builtins))


def test_commands_are_found() -> None:
    assert {command.split()[0] for command in COMMANDS} >= {"watch", "keys", "router", "record", "command"}
