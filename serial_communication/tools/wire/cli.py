"""The program `wire`: finds the module that is asked for. See `wire --help`."""
import argparse
import re
import sys
from typing import List, Optional

from ...output import prepare_output
from . import explain, listen, play, stats, tap
from .show import complain, no_more_output

PROGRAMS = {'explain': explain, 'listen': listen, 'tap': tap, 'play': play, 'stats': stats}

_DESCRIPTION = """\
The wire under a lens: what is on a serial line, in bytes and in words.

  got some hex?                       wire explain arduino 03 08 02 00
  what does the board say?            wire listen mcu /dev/ttyUSB0
  what do both say?                   wire tap arduino /dev/ttyUSB0 /tmp/tap
  the robot's day, again, at the desk wire play drive.bag mcu /tmp/board
  how good is that line?              wire stats drive.bag

wire stands for  rosrun serial_communication wire , or scripts/wire in a checkout; each program
below has its own --help.
"""


def main(arguments: Optional[List[str]] = None) -> int:
    """Run what the command line says; the exit status.

    A disk that is full, or a reader that has gone, costs one line at most.
    """
    prepare_output()
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()     # else the interpreter does, and says more than a line
    except BrokenPipeError:
        no_more_output()
        return 0
    except OSError as error:
        no_more_output()
        complain(f'wire: {error.filename or "its output cannot be written"}: {error.strerror}')
        return 1


def _run(arguments: Optional[List[str]]) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    # What roslaunch adds: __name:=… and remappings.
    arguments = [each for each in arguments if not re.match(r'[\w/~]+:=', each)]
    parser = argparse.ArgumentParser(prog='wire', description=_DESCRIPTION,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = parser.add_subparsers(dest='program', metavar='PROGRAM', required=True)
    for name, module in PROGRAMS.items():
        module.add_options(programs.add_parser(
            name, help=module.SUMMARY, description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter))
    options, rest = parser.parse_known_args(arguments)
    if 'hex' in options and not any(each.startswith('--') for each in rest):
        options.hex += rest     # bytes behind an option: argparse takes no second helping
    elif rest:
        parser.error(f'unrecognized arguments: {" ".join(rest)}')
    return PROGRAMS[options.program].run(options)


if __name__ == '__main__':
    sys.exit(main())
