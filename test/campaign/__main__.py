import os
import sys

from .cli import main

status = main()
sys.stdout.flush()
# Not through rospy's own end, which may wait for a bridge that is gone.
os._exit(status)
