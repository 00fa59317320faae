import os
import sys

from .cli import main

status = main()
sys.stdout.flush()
# rospy's own exit may wait for a bridge that has ended.
os._exit(status)
