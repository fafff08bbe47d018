"""What [mavlink] and the gimbal refuse, as a sentence with file, line and key."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from edge.config import load_config
from edge.errors import InputError

CAMERA = '[camera]\ntype = "sequence"\npath = "."\n'


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            '[mavlink]\nendpoints = ["udpin:127.0.0.1:14550", "serial:ttyS0:57600"]\n',
            r":5: \[mavlink\] endpoints\[1\]: 'serial:ttyS0:57600' is not udpin:HOST:PORT, .* or serial:DEVICE:BAUD",
        ),
        ("[mavlink]\nadsb_icao_address = 0x1000000\n", r":5: \[mavlink\] adsb_icao_address: must be at most 16777212"),
        ("[mavlink]\nsystem_id = 7\nvirtual_system_id = 7\n", r"\[mavlink\]: virtual_system_id must not be"),
        ('[mavlink]\nsigning_state = "s"\n', r"\[mavlink\]: signing_state needs signing_key"),
        ('[mavlink]\nsigning_state = "."\n', r":5: \[mavlink\] signing_state: .* is a folder"),
        (
            '[mavlink]\nallowed_hosts = ["10.0.0.1", "autopilot.local"]\n',
            r":5: \[mavlink\] allowed_hosts\[1\]: .* no address",
        ),
        ('[mavlink]\nendpoints = ["udpout:10.0.0.1:0"]\n', r":5: \[mavlink\] endpoints\[0\]: .* has port 0"),
        ("[mavlink]\ncommanders = [0]\n", r":5: \[mavlink\] commanders\[0\]: "),
        ('mount = "gimbal"\n[mavlink]\nenabled = false\n', r'the file: \[camera\] mount = "gimbal" needs \[mavlink\]'),
        (
            '[mavlink]\nendpoints = ["tcpout:10.0.0.1:5762", "tcpout:10.0.0.1:5762"]\n',
            r":4: \[mavlink\]: endpoints: tcpout:10.0.0.1:5762 is there twice",
        ),
        (
            '[mavlink]\nendpoints = ["serial:/dev/ttyS0:57600", "serial:/dev/ttyS0:115200"]\n',
            r":4: \[mavlink\]: endpoints: serial:/dev/ttyS0 is there twice",
        ),
        (
            '[zenoh]\nlisten = ["tcp/127.0.0.1:7448", "tcp/127.0.0.1:7448"]\n',
            r":4: \[zenoh\]: listen: tcp/127.0.0.1:7448 is there twice",
        ),
        ("[mavlink]\ngimbal_component_id = 154\n", r"the file: \[mavlink\] gimbal_component_id needs \[camera\] mount"),
        ('mount = "strapped"\n', r":4: \[camera\] mount: "),
    ],
)
def test_what_cannot_be_flown_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    config = tmp_path / "flight.toml"
    config.write_text(CAMERA + text)
    with pytest.raises(InputError) as refused:
        load_config(config)
    assert re.match(f"{re.escape(str(config))}.*{sentence}", str(refused.value)), refused.value


def test_a_gimbal_and_every_medium_are_taken(tmp_path: Path) -> None:
    config = tmp_path / "flight.toml"
    endpoints = ["serial:/dev/ttyAMA0:921600", "udpin:[::]:14550", "udpout:10.0.0.1:14550", "tcpin:0.0.0.0:5760"]
    config.write_text(f'{CAMERA}mount = "gimbal"\n[mavlink]\nendpoints = {[*endpoints, "tcpout:[::1]:5762"]}\n')
    read = load_config(config).config
    assert read.camera.mount == "gimbal"
    assert read.mavlink.endpoints == [*endpoints, "tcpout:[::1]:5762"]
