"""The program `wire`: runs the module that the command line names. See `wire --help`."""
import argparse
import signal

from ...output import end_with_output, prepare_output
from . import explain, listen, play
from .lines import WireError, note

PROGRAMS = {'explain': explain, 'listen': listen, 'play': play}


def main() -> int:
    """Run the program that the command line names, and return the exit status."""
    prepare_output()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)     # as Ctrl-C
    try:
        return end_with_output(_run)
    except KeyboardInterrupt:
        return 130
    except WireError as error:
        note(f'wire: {error}')
        return error.status
    except OSError as error:
        note(f'wire: {error.filename or "its output cannot be written"}: {error.strerror}')
        return 1


def _run() -> int:
    parser = argparse.ArgumentParser(
        prog='wire', description='What is on a serial line, in bytes and in words.',
        epilog='Each program has a --help.')
    programs = parser.add_subparsers(dest='program', metavar='PROGRAM', required=True)
    for name, module in PROGRAMS.items():
        module.add_options(programs.add_parser(
            name, help=module.SUMMARY, description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter))
    options, rest = parser.parse_known_args()
    if 'hex' in options and not any(each.startswith('--') for each in rest):
        options.hex += rest     # bytes after an option, which argparse does not collect
    elif rest:
        parser.error(f'unrecognized arguments: {" ".join(rest)}')
    return PROGRAMS[options.program].run(options)
