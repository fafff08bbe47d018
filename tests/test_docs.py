"""The documents say what is so: their tables are the code's, their files and commands are there, their examples do."""

from __future__ import annotations

import configparser
import dataclasses
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from edge import cli, config_reference, stages, threads
from edge.config import HealthSettings, load_config
from edge.daemon import TICK_S
from edge.links.zenoh_link import CLOSE_TIMEOUT_S
from edge.systemd import FEEDS_PER_LIMIT
from edge.watchdog import LAST_WORDS_S, LOOKS_PER_LIMIT
from msgs import topics
from msgs.ground.fleet import TargetRow
from msgs.recording import STOP_TIMEOUT_S

ROOT = Path(__file__).parents[1]
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()
INSTALL = (ROOT / "docs" / "install.md").read_text()
EXAMPLES = sorted(path for path in (ROOT / "deploy" / "examples").glob("*.toml") if not path.name.startswith("camera-"))
UNIT = ROOT / "deploy" / "uavpose-edge.service"


@pytest.mark.parametrize(
    ("name", "table"),
    [
        ("threads", threads.table_markdown()),
        ("stages", stages.table_markdown()),
        ("topics", topics.table_markdown()),
    ],
)
def test_the_tables_of_the_architecture_are_the_code_s(name: str, table: str) -> None:
    between = re.search(rf"<!-- {name}: .*?-->\n(.*?)<!-- {name}: end -->", ARCHITECTURE, re.DOTALL)
    assert between is not None
    assert between[1] == table


def test_the_configuration_s_page_is_the_code_s() -> None:
    page = (ROOT / "docs" / "configuration.md").read_text()
    assert page == config_reference.reference()
    for example in EXAMPLES:
        text = example.read_text()
        for key in re.findall(r"^(\w+) *=", text, re.MULTILINE):
            assert key == "type" or f"| `{key}` |" in page, (example, key)


def test_every_thread_of_the_daemon_is_in_the_table() -> None:
    sources = [*(ROOT / "edge").rglob("*.py"), ROOT / "msgs" / "recording.py", ROOT / "msgs" / "signals.py"]
    started = {
        name
        for path in sources
        for name in re.findall(r'(?:Thread\(.*?\bname|thread_name_prefix)="(\w+)"', path.read_text())
    }
    assert started == {row.name for row in threads.THREADS} - {"main"}
    assert started >= threads.FOREIGN


def test_files_that_the_architecture_names_are_there() -> None:
    rows = re.findall(r"^\| `(\w+/(?:\w+/)?)`[^|]*\| (.*) \|$", ARCHITECTURE, re.MULTILINE)
    assert {"edge/cameras/", "msgs/ground/", "trainer/", "sim_replay/"} <= {folder for folder, _ in rows}
    for folder, text in rows:
        for name in re.findall(r"`([\w*]+(?:\.py|/))`", text):
            assert list((ROOT / folder).glob(name.rstrip("/"))), f"{folder}{name}"


def test_the_keys_of_a_watched_pose_are_told() -> None:
    row = re.search(r"^\| `pose` \| (.*) \|$", (ROOT / "docs" / "ground.md").read_text(), re.MULTILINE)
    assert row is not None
    told = set(re.findall(r"`(\w+)`", row[1])) - {"ned", "cam"}
    assert told | {"uav"} == {"age_s", *(field.name for field in dataclasses.fields(TargetRow))}


@pytest.mark.parametrize("document", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", document.read_text()):
        assert "://" in target or (document.parent / target).exists(), target


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_each_example_is_found_valid_by_check(example: Path) -> None:
    command = [sys.executable, "-m", "edge.cli", "check", "--config", str(example)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{example}: valid")


def test_there_is_an_example_for_each_way_to_fly() -> None:
    ways = {(load_config(path).config.camera.type, load_config(path).config.mavlink.endpoints[0]) for path in EXAMPLES}
    kinds = {(camera, endpoint.partition(":")[0]) for camera, endpoint in ways}
    assert kinds == {("device", "serial"), ("stream", "udpin"), ("sequence", "udpin")}


def test_files_and_commands_of_the_guide_are_there() -> None:
    for name in re.findall(r"\bdeploy/[\w./-]+\w", INSTALL):
        assert (ROOT / name).exists(), name
    commands = re.findall(r"uavpose-edge ((?:check|doctor|status|run)\b.*)$", INSTALL, re.MULTILINE)
    assert {command.split()[0] for command in commands} >= {"check", "doctor", "status"}
    for command in commands:
        assert callable(cli._parser().parse_args(shlex.split(command, comments=True)).act)


def test_the_unit_starts_reloads_and_watches_the_daemon() -> None:
    unit = configparser.RawConfigParser(strict=False)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(UNIT)
    service = unit["Service"]
    _, *words = shlex.split(service["ExecStart"])
    assert callable(cli._parser().parse_args(words).act)
    assert service["Type"] == "notify"
    assert "-HUP" in service["ExecReload"]
    # Ours says where the loop stood, so it must come first, whatever is configured: noticed late by one look, with its
    # last words at their longest, where systemd was last fed long before the loop stood still.
    longest_s = HealthSettings.model_json_schema()["properties"]["loop_stuck_s"]["maximum"]
    ours_s = longest_s * (1 + 1 / LOOKS_PER_LIMIT) + LAST_WORDS_S
    systemd_s = float(service["WatchdogSec"]) * (1 - 1 / FEEDS_PER_LIMIT) - TICK_S
    assert ours_s < systemd_s
    # A router that does not answer, then a disk that takes nothing: what is lost is told after both.
    assert float(service["TimeoutStopSec"]) > CLOSE_TIMEOUT_S + STOP_TIMEOUT_S
    users = (ROOT / "deploy" / "uavpose.sysusers").read_text()
    assert f"\nu {service['User']} " in users
    for group in service["SupplementaryGroups"].split():
        assert f"\nm {service['User']} {group}\n" in users


def test_the_drivers_of_what_may_be_plugged_in_later_are_there_when_the_unit_starts() -> None:
    """systemd resolves a group of DeviceAllow= once, at the start, by /proc/devices (systemd.resource-control(5))."""
    unit = UNIT.read_text()
    modules = {"video4linux": "videodev", "ttyUSB": "usbserial", "ttyACM": "cdc_acm"}  # others are built in
    wanted = {f"modprobe@{modules[group]}.service" for group in re.findall(r"=char-(\w+)", unit) if group in modules}
    assert len(wanted) == len(modules)
    for key in ("Wants", "After"):
        assert wanted <= set(" ".join(re.findall(rf"^{key}=(.*)", unit, re.MULTILINE)).split())


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_unit_is_as_little_exposed_as_the_guide_says() -> None:
    told = re.search(r"exposure\s+is ([\d.]+) by `(systemd-analyze .*)`\s+\(systemd (\d+)\)", INSTALL)
    assert told is not None
    version = subprocess.run(["systemd-analyze", "--version"], capture_output=True, text=True, check=True).stdout
    if version.split()[1] != told[3]:
        pytest.skip(f"the guide's figure is of systemd {told[3]}; others look at more or less")
    done = subprocess.run(shlex.split(told[2]), capture_output=True, text=True, check=False, cwd=ROOT)
    assert f"exposure level for {UNIT.name}: {told[1]} " in done.stdout, done.stdout + done.stderr
