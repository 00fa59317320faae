"""The panel's command line. It imports neither ROS nor tornado, so --help works without them."""
import argparse
import re
import sys
from typing import List, Optional

from ...output import prepare_output


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f'{text!r} is not a port (0 … 65535)')
    return int(text)


def _token(text: str) -> str:
    if not re.fullmatch('[A-Za-z0-9._~-]{12,200}', text):     # it can be guessed over the network
        raise argparse.ArgumentTypeError(f'invalid token of {len(text)} characters: it must have '
                                         '12 … 200 of A-Z a-z 0-9 . _ ~ -')
    return text


def _arguments(argv: List[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='panel', description='Serve a web page that shows a bridge and its links, to whoever '
        'opens the address that is printed. Ctrl-C ends it.')
    parser.add_argument('--port', type=_port, default=8080,
                        help='TCP port to listen on; 0: any free one (default: %(default)s)')
    parser.add_argument('--bind', default='127.0.0.1', metavar='ADDRESS',
                        help='address to listen on; 0.0.0.0: all (default: %(default)s)')
    parser.add_argument('--node', default='/serial_communication', metavar='NAME',
                        help="the bridge's node name (default: %(default)s)")
    parser.add_argument('--control', action='store_true',
                        help='let the page move lift, gimbal, car or base')
    parser.add_argument('--token', type=_token,
                        help='a token of your own, instead of a random one of each start. Others '
                        'can see it in ps and in the log of roslaunch')
    return parser.parse_args(argv)


def main(argv: Optional[List[str]] = None) -> int:
    """Serve until a signal ends the program; return the exit status."""
    prepare_output()
    # roslaunch adds __name:=… and remappings.
    options = _arguments([each for each in sys.argv[1:] if ':=' not in each]
                         if argv is None else argv)
    from .program import run    # not at the top: it needs ROS and tornado
    return run(options)
