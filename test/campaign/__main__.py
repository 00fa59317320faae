import os
import sys

from .arguments import parse

options = parse()
# After the arguments are known to be right: `--help` needs nothing of what this imports.
from .cli import main  # noqa: E402

status = main(options)
sys.stdout.flush()
# rospy's own exit may wait for a bridge that has ended.
os._exit(status)
