"""The codecs that ours is timed beside carry the same pose; CDR is CDR, byte for byte."""

from __future__ import annotations

import json

import numpy as np
import pytest

from msgs.ground.bench import pose
from msgs.ground.bench_peers import installed
from msgs.ground.cli import main


def test_others_that_write_cdr_write_the_same_bytes_and_protobuf_the_same_numbers() -> None:
    message = pose()
    codecs = {codec.name: codec for codec in installed(message)}
    assert set(codecs) == {"rosbags", "pycdr2", "protobuf"}
    assert codecs["rosbags"].encode() == message.encode()
    assert codecs["pycdr2"].encode() == message.encode()
    decoded = codecs["protobuf"].decode()
    np.testing.assert_array_equal(np.reshape(decoded.covariance, (6, 6)), message.covariance)  # type: ignore[attr-defined]
    assert decoded.stamp_ns == message.stamp_ns  # type: ignore[attr-defined]


def test_the_command_times_each_codec_and_taking_a_sample_costs_more_than_decoding_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["bench", "--calls", "50", "--json"]) == 0
    ours, *others = json.loads(capsys.readouterr().out)
    assert ours["codec"] == "ours"
    assert 0.0 < ours["decode_us"] < ours["take_us"]
    assert all(one["encode_us"] > 0.0 and one["decode_us"] > 0.0 for one in others)
    assert main(["bench", "--calls", "1"]) == 0
    assert "pycdr2" in capsys.readouterr().out
