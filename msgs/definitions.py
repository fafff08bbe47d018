"""Interface definitions embedded in recordings so that readers need no ROS: ROS 2's concatenated .msg text.

https://mcap.dev/spec/registry, schema encoding `ros2msg`.
"""

from __future__ import annotations

from msgs.interfaces import INTERFACES

_SEPARATOR = "=" * 80 + "\n"


def definition(ros_type: str) -> str:
    """The interface `pkg/msg/Name` and all interfaces nested in it, each once, separated by a line of 80 `=` and
    `MSG: pkg/Name`.

    Raises KeyError for a type that no topic uses.
    """
    name = ros_type.replace("/msg/", "/")
    names = dict.fromkeys([name, *_nested(name)])
    own, *parts = (INTERFACES[each] if each == name else f"MSG: {each}\n{INTERFACES[each]}" for each in names)
    return _SEPARATOR.join([own, *parts])


def _nested(name: str) -> list[str]:
    """Interfaces nested in this one, depth first, with repetitions."""
    held = (line.split()[0].partition("[")[0] for line in INTERFACES[name].splitlines())
    return [inner for kind in held if "/" in kind for inner in (kind, *_nested(kind))]
