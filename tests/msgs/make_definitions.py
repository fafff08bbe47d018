"""Write msgs/interfaces.py from rosbags' interface definitions: python -m tests.msgs.make_definitions"""

from __future__ import annotations

from pathlib import Path

from msgs import topics

from .ros_oracle import STORE

PATH = Path(topics.__file__).parent / "interfaces.py"
HEAD = '''"""The ROS 2 interfaces that cross the wire, each as its .msg file has it. Generated: do not edit.

python -m tests.msgs.make_definitions
"""

INTERFACES = {
'''


def whole_definition(ros_type: str) -> str:
    """The definition of a type and of all that it holds, as rosbags writes it into a recording."""
    return STORE.generate_msgdef(ros_type, ros_version=2)[0]


def interfaces() -> str:
    """The module's text."""
    found = {}
    for topic in topics.TOPICS:
        own, *nested = whole_definition(topic.ros_type).split("=" * 80 + "\nMSG: ")
        found[topic.ros_type.replace("/msg/", "/")] = own
        found.update(part.split("\n", 1) for part in nested)
    entries = [f'    "{name}": """\\\n{text}""",\n' for name, text in sorted(found.items())]
    return HEAD + "".join(entries) + "}\n"


if __name__ == "__main__":
    PATH.write_text(interfaces())
