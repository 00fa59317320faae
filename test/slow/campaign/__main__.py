"""All faults at once, on real lines: checks the requirements of doc/safety.md against a
running bridge.

Half of the time the boards are on serial lines, then behind networks. After Ctrl-C it prints the
table of the results so far. The exit status is 0 only if no requirement was violated, and each was
tried as often as it has to be.
"""
import argparse
import os
from random import SystemRandom

parser = argparse.ArgumentParser(
    prog='campaign', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument('--duration', type=float, default=60.0, metavar='S',
                    help='in seconds (%(default)g)')
parser.add_argument('--hours', type=lambda text: float(text) * 3600, dest='duration', metavar='N',
                    help='the same in hours')
parser.add_argument('--seed', type=int, metavar='N', default=SystemRandom().randrange(1 << 31),
                    help='seed of the random numbers, to repeat a run')
parser.add_argument('--busy', type=int, default=2, metavar='N',
                    help='busy processes (%(default)d)')
parser.add_argument('--keep', default='', metavar='DIR',
                    help='keep all records here, not only those of a violation')
options = parser.parse_args()
if options.keep and os.path.isdir(options.keep) and os.listdir(options.keep):
    parser.error(f'{options.keep} is not empty')
# Only now: `--help` needs nothing that is installed or built.
from serial_communication.output import end_with_output  # noqa: E402
from .cli import main  # noqa: E402

status = end_with_output(lambda: main(options))
os._exit(status)        # rospy's own exit may wait for a bridge that has ended
