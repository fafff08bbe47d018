"""The `uavpose-ground` command."""

from __future__ import annotations

import argparse
import os
import sys
import threading
from pathlib import Path
from typing import TypeAlias

from msgs.command_line import exit_code, say_aside, say_out
from msgs.ground.errors import InputError
from msgs.session import CALLING, TlsFiles
from msgs.signals import stop_on_signals
from msgs.topics import check_uav_name, table_markdown

DOMAIN_MAX = 232  # of any daemon and router
NUMBER_MAX = 1e9  # of seconds, 31 years; of megabytes, a petabyte
HANGING_UP_S = 0.5  # time for a pending connection attempt to end if nothing listens
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def main(arguments: list[str] | None = None) -> int:
    """Exit codes: 0 done, 1 a command that was refused or a recording with gaps, 2 bad input (the message names file
    and key) or output that cannot be written, 130 interrupted, 141 output pipe closed."""
    options = _parser().parse_args(arguments)
    code = exit_code(lambda: int(options.act(options)), InputError, ["ground"])
    if _still_calls():
        # A connection attempt that returns from zenoh during interpreter shutdown would abort the process.
        os._exit(code)
    return code


def _still_calls() -> bool:
    calling = [thread for thread in threading.enumerate() if thread.name == CALLING]
    for thread in calling:
        thread.join(HANGING_UP_S)
    return any(thread.is_alive() for thread in calling)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavpose-ground",
        description="Ground station tools: watch, view, record and command vehicles over zenoh, and run their router.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    _add_watch(commands)
    _add_view(commands)
    _add_record(commands)
    _add_command(commands)
    _add_router(commands)
    _add_keys(commands)
    _add_tools(commands)
    return parser


def _add_watch(commands: Commands) -> None:
    watch = commands.add_parser("watch", help="show a live table of vehicles and their targets")
    _connection(watch)
    watch.add_argument(
        "--json",
        action="store_true",
        help="print one JSON object per line: pose, direction, health, event, refused, vehicle, link",
    )
    watch.add_argument(
        "--max-age", type=_not_negative, default=2.0, metavar="S", help="reject poses older than this (default 2)"
    )
    watch.add_argument("--seconds", type=_positive, help="stop after this many seconds (default: on Ctrl-C)")
    watch.set_defaults(act=_watch)


def _add_view(commands: Commands) -> None:
    view = commands.add_parser(
        "view",
        help="show images, a 3-D scene and plots in Rerun, live or from recordings",
        description="Show live data from vehicles, or recordings, in Rerun's viewer. The boxes of targets are drawn "
        "with --target-size: vehicles do not send a target's size.",
    )
    view.add_argument("recordings", type=Path, nargs="*", metavar="MCAP", help="recordings (default: live)")
    _connection(view)
    where = view.add_mutually_exclusive_group()
    where.add_argument(
        "--web",
        type=int,
        nargs="?",
        const=9090,
        metavar="PORT",
        help="serve a page to browsers on this machine (PORT defaults to 9090)",
    )
    where.add_argument("--save", type=Path, metavar="RRD", help="write a file for the viewer instead")
    view.add_argument(
        "--target-size", type=_positive, nargs=3, default=(8.0, 12.0, 2.5), metavar=("LENGTH", "WIDTH", "HEIGHT"),
        help="size of the boxes drawn, in metres (default 8 12 2.5)",
    )  # fmt: skip
    view.add_argument(
        "--max-age", type=_not_negative, default=2.0, metavar="S", help="reject poses older than this (default 2)"
    )
    view.add_argument("--seconds", type=_positive, help="stop after this many seconds (default: on Ctrl-C)")
    view.set_defaults(act=_view)


def _add_record(commands: Commands) -> None:
    record = commands.add_parser("record", help="record the messages of vehicles in MCAP files")
    _connection(record)
    record.add_argument("--dir", type=Path, default=Path("recordings"), help="folder (default: recordings)")
    record.add_argument(
        "--file-mb", type=_positive, default=256.0, help="size at which a new file begins (default 256)"
    )
    record.add_argument(
        "--file-minutes", type=_positive, default=10.0, help="duration after which a new file begins (default 10)"
    )
    record.add_argument("--total-mb", type=_positive, help="limit for all files together (default: only --free-mb)")
    record.add_argument(
        "--free-mb", type=_not_negative, default=1000.0, help="space to leave free on the disk (default 1000)"
    )
    record.add_argument(
        "--when-full",
        choices=("oldest", "stop"),
        default="oldest",
        help="at a limit: remove the oldest files (default), or stop",
    )
    record.add_argument("--seconds", type=_positive, help="stop after this many seconds (default: on Ctrl-C)")
    record.set_defaults(act=_record)


def _add_command(commands: Commands) -> None:
    command = commands.add_parser(
        "command", help="command one vehicle: track, select, stop, reload, record or limit its rate"
    )
    _endpoint(command)
    command.add_argument("uav", help="the vehicle's name")
    command.add_argument("name", metavar="command", help="track, select, stop, reload, record or rate")
    command.add_argument(
        "words", nargs="*", help="track: LEFT TOP RIGHT BOTTOM, 0 to 1; select: t0; record: on, off; rate: HZ, all"
    )
    command.set_defaults(act=_command)


def _add_router(commands: Commands) -> None:
    router = commands.add_parser(
        "router", help="run the router that vehicles and tools connect to; no other zenoh router is needed"
    )
    router.add_argument("--config", type=Path, required=True, help="TOML file: listen, [tls], [access]")
    router.set_defaults(act=_router)


def _add_keys(commands: Commands) -> None:
    keys = commands.add_parser("keys", help="create and list certificates for TLS and QUIC").add_subparsers(
        required=True, metavar="ACTION"
    )
    init = keys.add_parser("init", help="create the certificate authority: ca.pem and ca.key")
    issue = keys.add_parser("issue", help="create NAME.pem and NAME.key, signed by the authority in the folder")
    issue.add_argument("name", help="identity: a vehicle's name, an operator, the router")
    issue.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="HOST",
        help="DNS name or IP address at which it is reached; repeatable",
    )
    show = keys.add_parser("list", help="list the certificates in the folder and until when each is valid")
    show.set_defaults(act=_keys_list)
    for action in (init, issue, show):
        action.add_argument("--dir", type=Path, default=Path("keys"), help="folder of the keys (default: keys)")
    init.add_argument("--days", type=int, default=3650, help="days of validity (default 3650)")
    issue.add_argument("--days", type=int, default=825, help="days of validity (default 825)")
    init.set_defaults(act=_keys_init)
    issue.set_defaults(act=_keys_issue)


def _add_tools(commands: Commands) -> None:
    bench = commands.add_parser(
        "bench", help="measure encoding and decoding of a pose, compared with rosbags if it is installed"
    )
    bench.add_argument("--calls", type=int, default=2000, help="calls in each of seven rounds (default 2000)")
    bench.add_argument("--json", action="store_true", help="print one JSON array instead of a table")
    bench.set_defaults(act=_bench)

    topics = commands.add_parser("topics", help="print the table of topics as Markdown")
    topics.set_defaults(act=_topics)


def _positive(text: str) -> float:
    value = _number(text)
    if not 0.0 < value <= NUMBER_MAX:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number of at most {NUMBER_MAX:.0f}")
    return value


def _not_negative(text: str) -> float:
    value = _number(text)
    if not 0.0 <= value <= NUMBER_MAX:
        raise argparse.ArgumentTypeError(f"{text} is not a number of at least 0 and at most {NUMBER_MAX:.0f}")
    return value


def _ros_domain(text: str) -> int:
    if not text.isdecimal() or int(text) > DOMAIN_MAX:
        raise argparse.ArgumentTypeError(f"{text} is not a ROS domain, 0 to {DOMAIN_MAX}")
    return int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _connection(command: argparse.ArgumentParser) -> None:
    _endpoint(command)
    command.add_argument("--uav", action="append", default=[], metavar="NAME", help="only this vehicle; repeatable")
    command.add_argument("--domain", type=_ros_domain, default=0, help="ROS domain (default 0)")


def _endpoint(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "-e",
        "--connect",
        default="tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
        help="router or daemon (default %(default)s)",
    )
    for name, what in (("ca", "the authority's certificate"), ("cert", "own certificate"), ("key", "its private key")):
        command.add_argument(f"--{name}", type=Path, metavar="PEM", help=f"{what}, for tls/ and quic/ endpoints")


def _tls(options: argparse.Namespace) -> TlsFiles | None:
    given = (options.ca, options.cert, options.key)
    if not any(given):
        return None
    if not all(given):
        raise InputError("--ca, --cert and --key must be given together")
    return TlsFiles(*given)


def _uav(name: str) -> str:
    try:
        return check_uav_name(name)
    except ValueError as error:
        raise InputError(str(error)) from error


def _watch(options: argparse.Namespace) -> int:
    from msgs.ground.watch import Terminal, WatchOptions, watch

    asked = WatchOptions(
        options.connect,
        _tls(options),
        [_uav(name) for name in options.uav],
        options.domain,
        options.max_age,
        options.json,
    )
    return watch(asked, _stop_on_signal(options.seconds), Terminal(), say_aside)


def _view(options: argparse.Namespace) -> int:
    from msgs.ground.view.command import ViewOptions, view

    if options.web is not None and not 0 < options.web < 65535:
        raise InputError(f"--web {options.web}: must be a port from 1 to 65534; the next port is used too")
    asked = ViewOptions(
        options.recordings,
        options.connect,
        _tls(options),
        [_uav(name) for name in options.uav],
        options.domain,
        options.max_age,
        tuple(options.target_size),
        options.save,
        options.web,
    )
    return view(asked, _stop_on_signal(options.seconds), say_aside)


def _record(options: argparse.Namespace) -> int:
    from msgs.ground.record import record
    from msgs.recording_store import RecordingLimits

    limits = RecordingLimits(
        file_bytes_max=round(options.file_mb * 1e6),
        file_seconds_max=60.0 * options.file_minutes,
        total_bytes_max=None if options.total_mb is None else round(options.total_mb * 1e6),
        free_bytes_min=round(options.free_mb * 1e6),
        when_full=options.when_full,
    )
    if options.total_mb is not None and options.total_mb < 2 * options.file_mb:
        raise InputError("--total-mb must be at least twice --file-mb: otherwise nothing is left when a file begins")
    stop, uavs = _stop_on_signal(options.seconds), [_uav(name) for name in options.uav]
    return record(options.connect, _tls(options), uavs, options.domain, options.dir, limits, stop, say_aside)


def _command(options: argparse.Namespace) -> int:
    from msgs.ground.command import command

    uav, stop = _uav(options.uav), _stop_on_signal()
    return command(options.connect, _tls(options), uav, options.name, options.words, stop, say_aside)


def _bench(options: argparse.Namespace) -> int:
    from msgs.ground.bench import bench, table, to_json

    if options.calls < 1:
        raise InputError("--calls must be an integer of at least 1")
    timings = bench(options.calls)
    say_out(to_json(timings) if options.json else table(timings))
    return 0


def _topics(_: argparse.Namespace) -> int:
    say_out(table_markdown(), end="")
    return 0


def _stop_on_signal(after_s: float | None = None) -> threading.Event:
    """An event set by SIGTERM and Ctrl-C, or after `after_s`."""
    stop = stop_on_signals()
    if after_s is not None:
        timer = threading.Timer(after_s, stop.set)
        timer.daemon = True
        timer.start()
    return stop


def _router(options: argparse.Namespace) -> int:
    from msgs.ground.router import route

    return route(options.config, _stop_on_signal(), say_aside)


def _keys_init(options: argparse.Namespace) -> int:
    from msgs.ground import keys

    for path in keys.init_authority(options.dir, options.days):
        say_out(str(path))
    return 0


def _keys_list(options: argparse.Namespace) -> int:
    from msgs.ground.keys import listing

    say_out("\n".join(listing(options.dir)))
    return 0


def _keys_issue(options: argparse.Namespace) -> int:
    from msgs.ground import keys

    files = keys.issue(options.dir, options.name, options.host, options.days)
    say_out(f"{files.certificate}\n{files.private_key}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
