"""Measures latency, jitter and CPU time of the bridge on this machine. Takes about eight minutes.

The bench starts its own roscore, the bridge, boards behind pseudo terminals, and the references: a
node that polls its port, a node that only publishes, and with --against the bridge of another
commit. All take turns in rounds of six seconds, and the best of four rounds counts. The exit status
is 0 if the bench worked, whatever it measured.
"""
# `--help` needs nothing that is installed or built, so this imports only the standard library.
import argparse
from typing import List, Optional

SECTIONS = 'latency', 'busy', 'stamps', 'nano', 'cpu', 'bus', 'flood', 'bridges'


def parse(arguments: Optional[List[str]] = None) -> argparse.Namespace:
    """Return the options; print the usage and exit if that is asked for, or they are wrong."""
    parser = argparse.ArgumentParser(
        prog='bench', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--short', action='store_true',
                        help='two rounds of one second each, only to check that the bench works')
    parser.add_argument('--against', metavar='COMMIT', default='',
                        help='build this commit and measure its bridge in the same rounds')
    parser.add_argument('--only', metavar='SECTION,...', type=_sections, default=list(SECTIONS),
                        help='measure only these sections, of ' + ', '.join(SECTIONS))
    parser.add_argument('--json', metavar='FILE', help='write the figures to this file')
    return parser.parse_args(arguments)


def _sections(text: str) -> List[str]:
    names = text.split(',')
    for name in names:
        if name not in SECTIONS:
            raise argparse.ArgumentTypeError(f"{name!r} is not one of {', '.join(SECTIONS)}")
    return names
