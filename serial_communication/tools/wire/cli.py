"""The program `wire`: runs the module that the command line names. See `wire --help`."""
import argparse
import signal
import sys
from typing import List, Optional

from ...output import end_with_output, prepare_output
from . import explain, listen, play
from .lines import WireError, note

PROGRAMS = {'explain': explain, 'listen': listen, 'play': play}

_DESCRIPTION = """\
What is on a serial line, in bytes and in words. Each program below has a --help.

  wire explain arduino 03 08 02 00
  wire listen mcu /dev/ttyUSB0
  wire play drive.bag mcu /tmp/board
"""


def main(arguments: Optional[List[str]] = None) -> int:
    """Run the program that the command line names, and return the exit status."""
    prepare_output()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)     # as Ctrl-C
    try:
        return end_with_output(lambda: _run(sys.argv[1:] if arguments is None else arguments))
    except KeyboardInterrupt:
        return 130
    except WireError as error:
        note(f'wire: {error}')
        return error.status
    except OSError as error:
        note(f'wire: {error.filename or "its output cannot be written"}: {error.strerror}')
        return 1


def _run(arguments: List[str]) -> int:
    parser = argparse.ArgumentParser(prog='wire', description=_DESCRIPTION,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = parser.add_subparsers(dest='program', metavar='PROGRAM', required=True)
    for name, module in PROGRAMS.items():
        module.add_options(programs.add_parser(
            name, help=module.SUMMARY, description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter))
    options, rest = parser.parse_known_args(arguments)
    if 'hex' in options and not any(each.startswith('--') for each in rest):
        options.hex += rest     # bytes after an option, which argparse does not collect
    elif rest:
        parser.error(f'unrecognized arguments: {" ".join(rest)}')
    return PROGRAMS[options.program].run(options)
