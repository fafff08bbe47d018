"""Write msgs/definitions.py from rosbags' interface definitions: python -m tests.msgs.make_definitions"""

from __future__ import annotations

from pathlib import Path

from msgs import topics

from .ros_oracle import STORE

PATH = Path(topics.__file__).parent / "definitions.py"
HEAD = '''"""The ROS 2 interface definitions that recordings carry, so that readers need no ROS. Generated: do not edit.

python -m tests.msgs.make_definitions
"""

DEFINITIONS = {
'''


def definitions() -> str:
    """The module's text."""
    ros_types = sorted({topic.ros_type for topic in topics.TOPICS})
    entries = [
        f'    "{ros_type}": """\\\n{STORE.generate_msgdef(ros_type, ros_version=2)[0]}""",\n' for ros_type in ros_types
    ]
    return HEAD + "".join(entries) + "}\n"


if __name__ == "__main__":
    PATH.write_text(definitions())
