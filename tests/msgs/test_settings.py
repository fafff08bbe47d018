"""Settings as people get them wrong: every package tells the file, the key and the reason, in an error of its own."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from edge.config import load_config as load_daemon
from edge.errors import InputError
from msgs.ground.errors import InputError as GroundError
from msgs.ground.router import load_router
from sim_replay.benchmark.preset import load_preset
from sim_replay.bop import BopError, read_model_frames
from sim_replay.faults.timeline import load_timeline
from trainer.config import ConfigError
from trainer.config import load_config as load_trainer

READERS: list[tuple[Callable[[Path], Any], type[Exception]]] = [
    (load_daemon, InputError),
    (load_router, GroundError),
    (lambda path: load_preset(str(path)), InputError),
    (load_timeline, InputError),
    (load_trainer, ConfigError),
    (lambda path: read_model_frames(path.parent), BopError),
]


@pytest.mark.parametrize(("read", "error"), READERS)
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b'name = "\xff"', "cannot be read: not UTF-8 text"),
        (b"a = \n", "not valid TOML: "),
        (b"gremlin = 1", "gremlin"),
    ],
)
def test_what_cannot_be_read_is_told_by_its_file(
    tmp_path: Path, read: Callable[[Path], Any], error: type[Exception], content: bytes, reason: str
) -> None:
    path = tmp_path / "model_frame.toml"
    path.write_bytes(content)
    with pytest.raises(error) as told:
        read(path)
    lines = str(told.value).splitlines()
    assert all(line.startswith(f"{path}:") for line in lines)
    assert any(reason in line for line in lines)


def test_each_fault_has_a_line_with_its_key(tmp_path: Path) -> None:
    path = tmp_path / "router.toml"
    path.write_text('listen = []\ndomain = "one"\n[access]\nvehicles = ["uav1", "uav/2"]\nreader = []\n')
    with pytest.raises(GroundError) as told:
        load_router(path)
    lines = str(told.value).splitlines()
    keys = {line.removeprefix(f"{path}: ").partition(":")[0] for line in lines}
    assert keys == {"listen", "domain", "access.vehicles.1", "access.reader"}
    assert f"{path}: access.reader: unknown key" in lines


@pytest.mark.parametrize(
    ("read", "error", "text", "key"),
    [
        (load_router, GroundError, "domain = true", "domain"),
        (load_router, GroundError, 'domain = "0"', "domain"),
        (lambda path: load_preset(str(path)), InputError, "fps = [true]", "fps.0"),
        (lambda path: load_preset(str(path)), InputError, "size_wh_px = [640, false]", "size_wh_px.1"),
        (lambda path: load_preset(str(path)), InputError, 'range_m = ["100", 500]', "range_m.0"),
        (load_trainer, ConfigError, '[data]\nbatch_size = "24"', "data.batch_size"),
        (load_trainer, ConfigError, "[contract]\ntrained_range_m = [true, 500.0]", "contract.trained_range_m.0"),
        (load_trainer, ConfigError, "[contract]\nacquire_size_wh = [640, true]", "contract.acquire_size_wh.1"),
    ],
)
def test_true_and_quoted_numbers_are_no_numbers(
    tmp_path: Path, read: Callable[[Path], Any], error: type[Exception], text: str, key: str
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(error) as told:
        read(path)
    lines = [line for line in str(told.value).splitlines() if line.startswith(f"{path}: {key}: ")]
    assert len(lines) == 1
    assert re.search(r": must be a (whole )?number$", lines[0])
