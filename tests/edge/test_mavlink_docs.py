"""docs/mavlink.md says what the code does."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from edge.config import load_config
from edge.links.mavlink_table import READ, SENT
from edge.links.signing_key import write_new_key
from msgs.mavlink import dialect

DOCS = (Path(__file__).parents[2] / "docs" / "mavlink.md").read_text()
EXAMPLES = re.findall(r"```toml\n(.*?)```", DOCS, flags=re.DOTALL)


def test_the_tables_are_what_the_command_prints() -> None:
    printed = subprocess.run(
        [sys.executable, "-m", "edge.links.mavlink_table"], capture_output=True, text=True, check=True
    ).stdout
    assert f"<!-- tables -->\n{printed}<!-- end of tables -->" in DOCS


def test_ids_and_names_are_the_dialects() -> None:
    for row in (*SENT, *READ):
        assert dialect.mavlink_map[row.message_id].msgname == row.name


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_are_valid_configurations(tmp_path: Path, example: str) -> None:
    write_new_key(tmp_path / "mavlink.key")
    camera = "" if "[camera]" in example else '[camera]\ntype = "sequence"\npath = "."\n'
    config = tmp_path / "flight.toml"
    config.write_text(camera + example)
    assert load_config(config).config.mavlink.enabled
