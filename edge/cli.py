"""The `uavpose-edge` command."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from pathlib import Path

from edge.align import command as align
from edge.bench import command as bench
from edge.errors import InputError
from edge.logs import set_up_logging
from msgs.command_line import exit_code, say_out
from msgs.signals import on_signals


def main(arguments: list[str] | None = None) -> int:
    """Exit codes: 0 done, 2 bad input (with a sentence that names file and key), 130 interrupted, 141 output closed."""
    options = _parser().parse_args(arguments)
    set_up_logging()
    return exit_code(lambda: int(options.act(options)), InputError)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavpose-edge",
        description="Estimate the pose of other fixed-wing aircraft with one camera; publish it by zenoh and MAVLink.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run the daemon: read the camera and publish poses until stopped")
    run.add_argument("--config", type=Path, required=True, help="TOML file")
    run.set_defaults(act=_run)

    check = commands.add_parser("check", help="validate a configuration with its model and camera, and print a summary")
    check.add_argument("--config", type=Path, required=True, help="TOML file")
    check.set_defaults(act=_check)

    status = commands.add_parser("status", help="query the state of the running daemon")
    status.add_argument("--config", type=Path, help="the daemon's TOML file, for its address and name")
    status.add_argument(
        "-e", "--connect", metavar="ENDPOINT", help="the daemon's zenoh endpoint (default tcp/127.0.0.1:7448)"
    )
    status.add_argument("--vehicle", default=None, help="the vehicle's name (default: any that answers)")
    status.add_argument("--json", action="store_true", help="print one JSON object: info, config, model")
    status.set_defaults(act=_status)

    doctor = commands.add_parser(
        "doctor", help="check everything the daemon needs on this machine, with advice on faults"
    )
    doctor.add_argument("--config", type=Path, required=True, help="TOML file")
    doctor.add_argument("--json", action="store_true", help="print one JSON object: findings and advice")
    doctor.set_defaults(act=_doctor)

    bench.register(commands)

    calibrate = commands.add_parser(
        "calibrate", help="calibrate a camera from images of a board, and write its intrinsics file"
    )
    calibrate.add_argument("source", type=Path, nargs="?", help="video, or folder of images, of a board held still")
    calibrate.add_argument("--out", type=Path, default=Path("camera.yaml"), help="output file (default camera.yaml)")
    calibrate.add_argument("--name", default="camera", help="camera name in the file (default camera)")
    calibrate.add_argument(
        "--pattern", choices=("charuco", "chessboard"), default="charuco", help="kind of board (default charuco)"
    )
    calibrate.add_argument(
        "--squares", default="9x6", help="number of squares, black and white, columns x rows (default 9x6)"
    )
    calibrate.add_argument(
        "--dictionary", default="5X5_100", help="marker dictionary of a ChArUco board (default 5X5_100)"
    )
    calibrate.add_argument(
        "--marker-share", type=float, default=0.75, help="side of a marker / side of a square (default 0.75)"
    )
    calibrate.add_argument(
        "--coefficients",
        type=int,
        choices=(4, 5, 8),
        default=4,
        help="number of distortion coefficients: k1 k2 p1 p2, k3, k4 k5 k6 (default 4)",
    )
    calibrate.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    calibrate.add_argument("--draw", type=Path, metavar="PNG", help="only write an image of the board, for printing")
    calibrate.set_defaults(act=_calibrate)

    align.register(commands)

    keygen = commands.add_parser("keygen", help="write a new MAVLink signing key, for [mavlink] signing_key")
    keygen.add_argument("--out", type=Path, required=True, help="output file; an existing one is not overwritten")
    keygen.set_defaults(act=_keygen)
    return parser


def _run(options: argparse.Namespace) -> int:
    # Must not end the process before it can be handled: the configuration has not been read yet.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    from edge.config import load_config
    from edge.daemon import run
    from edge.reload import Reloader
    from edge.threads import left_behind

    stop, reloader = threading.Event(), Reloader()
    on_signals({signal.SIGHUP: reloader.ask, signal.SIGTERM: stop.set, signal.SIGINT: stop.set})
    config = load_config(options.config)
    code = exit_code(lambda: run(config, stop, reloader), InputError)
    if left_behind():
        # Such a thread would return from its library during interpreter shutdown and abort the process.
        logging.shutdown()
        os._exit(code)
    return code


def _check(options: argparse.Namespace) -> int:
    from edge.check import check
    from edge.config import load_config

    say_out("\n".join(check(load_config(options.config))))
    return 0


def _status(options: argparse.Namespace) -> int:
    from edge.status import status

    return status(options.config, options.connect, options.vehicle, options.json)


def _doctor(options: argparse.Namespace) -> int:
    from edge.config import load_config
    from edge.doctor import doctor

    return doctor(load_config(options.config), options.json)


def _calibrate(options: argparse.Namespace) -> int:
    from edge.calibrate import calibrate, refuse_unwritable, report, to_json, write_calibration
    from edge.calibrate_board import BoardSettings, board_squares, write_board

    squares = board_squares(options.squares)
    board = BoardSettings(options.pattern, squares, options.dictionary, options.marker_share)
    if options.draw is not None:
        write_board(board, options.draw)
        return 0
    if options.source is None:
        raise InputError("calibrate needs a video, a folder of images, or --draw")
    refuse_unwritable(options.out)
    found = calibrate(options.source, board, options.coefficients)
    write_calibration(found, options.name, options.out)
    say_out(to_json(found) if options.json else "\n".join(report(found, options.out)))
    return 0


def _keygen(options: argparse.Namespace) -> int:
    from edge.links.signing_key import write_new_key

    write_new_key(options.out)
    say_out(f"{options.out}: 32 random bytes, readable by its owner only; the autopilot needs the same key")
    return 0


if __name__ == "__main__":
    sys.exit(main())
