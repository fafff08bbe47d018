"""The `uavpose-ground` command."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path

from msgs.ground.errors import InputError

EXIT_BAD_INPUT = 2


def main(arguments: list[str] | None = None) -> int:
    """Exit codes: 0 done, 2 bad input, told in a sentence that names file and key."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.act(options))
    except InputError as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavpose-ground", description="The ground's end: route, watch and record what vehicles tell over zenoh."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    router = commands.add_parser("router", help="what vehicles and tools connect to; no other zenoh router is needed")
    router.add_argument("--config", type=Path, required=True, help="TOML file: listen, [tls], [access]")
    router.set_defaults(act=_router)

    keys = commands.add_parser("keys", help="certificates for TLS and QUIC").add_subparsers(
        required=True, metavar="ACTION"
    )
    init = keys.add_parser("init", help="make the authority: ca.pem and ca.key")
    issue = keys.add_parser("issue", help="make NAME.pem and NAME.key, signed by the authority in the folder")
    issue.add_argument("name", help="identity: a vehicle's name, an operator, the router")
    issue.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="HOST",
        help="DNS name or IP address it is reached at; repeatable",
    )
    for action in (init, issue):
        action.add_argument("--dir", type=Path, default=Path("keys"), help="folder of the keys (default: keys)")
    init.add_argument("--days", type=int, default=3650, help="validity (default: ten years)")
    issue.add_argument("--days", type=int, default=825, help="validity (default: 825)")
    init.set_defaults(act=_keys_init)
    issue.set_defaults(act=_keys_issue)
    return parser


def _stop_on_signal() -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop


def _router(options: argparse.Namespace) -> int:
    from msgs.ground.router import route

    return route(options.config, _stop_on_signal(), lambda text: print(text, flush=True))


def _keys_init(options: argparse.Namespace) -> int:
    from msgs.ground import keys

    for path in keys.init_authority(options.dir, options.days):
        print(path)
    return 0


def _keys_issue(options: argparse.Namespace) -> int:
    from msgs.ground import keys

    files = keys.issue(options.dir, options.name, options.host, options.days)
    print(files.certificate, files.private_key, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
