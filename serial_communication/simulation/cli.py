"""The program: one simulated board on one serial port, until it is stopped."""
import argparse
import os
import re
import signal
import sys
import threading
import time
from random import SystemRandom
from typing import Any, List, Optional

from ..links.port import Port, check_url
from ..protocols import robot_ctrl_bus
from . import arduino, bus, faults, mcu
from .board import Runner
from .journal import Journal

_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_BURST, _RATE = 20, 2.0      # lines for people: in a burst, and a second after that

_LONGEST = 150               # characters of one

_EXAMPLES = """\
examples:
  socat_pair /tmp/ttyV0 /tmp/ttyV1 &            two linked ports: one for the bridge, one for us
  simulator bus --port /tmp/ttyV1
  simulator bus --port /tmp/ttyV1 --fault late=0.05 --fault reset=1/min
  simulator arduino --port /tmp/ttyV3 --calibration-time 60
  simulator mcu --port /tmp/ttyV5 --adc --rate 50 --journal mcu.jsonl
  simulator arduino --port /tmp/ttyV3 --fault all --seed 7

It waits for a port that is absent and comes back to one that vanished. Ctrl-C ends it.
"""


def main(arguments: Optional[List[str]] = None) -> int:
    """Run what the command line says; the exit status."""
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    say = _Voice(options.board)
    try:
        journal = Journal(options.journal) if options.journal else None
    except OSError as error:
        print('journal %s: %s' % (options.journal, error.strerror), file=sys.stderr)
        return 1
    # Threads inherit the mask, so that only sigwait below takes these signals.
    signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
    sabotage = faults.Faults(options.rates, options.seed)
    board = _board(options)
    runner = Runner(board, Port(options.port, options.baud), say, board.NAME == 'arduino',
                    faults=sabotage, journal=journal,
                    baud=options.baud if options.baud_pace else 0)
    rates = {name: str(rate) for name, rate in options.rates.items()}
    if rates:
        say('seed %d, faults %s' % (options.seed, ' '.join('%s=%s' % pair
                                                           for pair in rates.items())))
    if journal:
        journal.write(time.monotonic(), 'start', {
            'board': options.board, 'port': options.port, 'pid': os.getpid(),
            'seed': options.seed, 'faults': rates})
    status: List[int] = []
    thread = threading.Thread(target=_run, args=(runner, status), name='board', daemon=True)
    thread.start()
    if options.duration:
        signal.sigtimedwait(_STOPS, options.duration)
    else:
        signal.sigwait(_STOPS)
    runner.stop()
    thread.join(1.0)
    if journal:
        journal.write(time.monotonic(), 'end', {'frames': runner.line.frames,
                                                'faults': sabotage.counts})
        journal.close()
        if journal.trouble:
            say(journal.trouble)
    if rates:
        say('%d frames; faults: %s' % (runner.line.frames, ', '.join(
            '%s %d' % pair for pair in sabotage.counts.items()) or 'none'))
    say.end()
    return status[0] if status else 0


def _run(runner: Runner, status: List[int]) -> None:
    try:
        runner.run()
    except BaseException:
        status.append(1)
        os.kill(os.getpid(), signal.SIGTERM)    # wakes the main thread
        raise


def _board(options: argparse.Namespace) -> Any:
    if options.board == 'bus':
        return bus.ControlBoard(options.lift_speed, options.gimbal_speed, options.max_length,
                                options.reply_has_cmd2, options.seed)
    if options.board == 'arduino':
        return arduino.ModelCar(options.calibration_time, options.seed)
    return mcu.SensorBoard(options.rate, options.adc, options.seed)


class _Voice:
    """Lines for people, not more than they can read. A reader that has gone does not matter."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._credit = float(_BURST)
        self._at = time.monotonic()
        self._left_out = 0

    def __call__(self, text: str) -> None:
        now = time.monotonic()
        self._credit = min(_BURST, self._credit + (now - self._at) * _RATE)
        self._at = now
        if self._credit < 1:
            self._left_out += 1
            return
        self._credit -= 1
        if len(text) > _LONGEST:
            text = text[:_LONGEST] + ' …'
        if self._left_out:
            text += ' (%d more left out before this)' % self._left_out
            self._left_out = 0
        try:
            print('%s: %s' % (self._name, text), flush=True)
        except (OSError, ValueError):
            pass

    def end(self) -> None:
        """Leave nothing that the interpreter would fail to flush."""
        try:
            sys.stdout.flush()
        except (OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


# -- the command line -------------------------------------------------------------------------


def _parse(arguments: List[str]) -> argparse.Namespace:
    # What roslaunch adds: __name:=… and remappings.
    arguments = [each for each in arguments if not re.match(r'[\w/~]+:=', each)]
    parser = argparse.ArgumentParser(
        prog='simulator', epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='A simulated board on a serial port, for trying a bridge without hardware.')
    boards = parser.add_subparsers(dest='board', metavar='BOARD', required=True)
    one = _add(boards, 'bus', bus, 'main control board: lift, gimbal, air')
    one.add_argument('--lift-speed', type=_positive, default=bus.LIFT_SPEED, metavar='MM/S',
                     help='how fast the lift moves (%(default)g)')
    one.add_argument('--gimbal-speed', type=_positive, default=bus.GIMBAL_SPEED, metavar='DEG/S',
                     help='how fast the gimbal turns (%(default)g)')
    one.add_argument('--max-length', type=_max_length, default=robot_ctrl_bus.MAX_LENGTH,
                     metavar='N', help='longest DATE that it accepts (%(default)d)')
    one.add_argument('--reply-has-cmd2', action='store_true',
                     help="replies carry their request's CMD2")
    one = _add(boards, 'arduino', arduino, 'model car: motor, servo, encoder, IMU, battery')
    one.add_argument('--calibration-time', type=_positive, default=10.0, metavar='S',
                     help='how long an IMU calibration takes (%(default)g; the real one: over 300)')
    one = _add(boards, 'mcu', mcu, 'sensor board: two ranges and orientation, or six ADC channels')
    one.add_argument('--rate', type=_positive, default=mcu.RATE, metavar='HZ',
                     help='frames a second (%(default)g)')
    one.add_argument('--adc', action='store_true', help='be the board with six ADC channels')
    options = parser.parse_args(arguments)
    try:
        options.rates = faults.parse(options.fault, options.board)
    except ValueError as error:
        parser.error(str(error))
    if options.seed is None:
        options.seed = SystemRandom().randrange(1 << 31)
    return options


def _add(boards: Any, name: str, module: Any, summary: str) -> argparse.ArgumentParser:
    parser = boards.add_parser(
        name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter,
        description=module.__doc__, epilog=_fault_help(name))
    parser.add_argument('--port', required=True, type=_port,
                        help='a device, or whatever pyserial opens')
    parser.add_argument('--baud', type=int, default=115200, help='(%(default)d)')
    parser.add_argument('--baud-pace', action='store_true',
                        help='send no faster than that; a pseudo terminal has no speed of its own')
    parser.add_argument('--fault', action='append', default=[], metavar='KIND=RATE[:S]',
                        help='see below; may be given more than once')
    parser.add_argument('--seed', type=int, metavar='N',
                        help='of faults and noise, so that a run can be repeated')
    parser.add_argument('--journal', metavar='FILE',
                        help='append what happens, a JSON object a line (described in '
                             'serial_communication/simulation/journal.py)')
    parser.add_argument('--duration', type=_positive, metavar='S', help='end after that')
    return parser


def _fault_help(board: str) -> str:
    lines = ['faults: KIND=RATE[:SECONDS], as flip=0.01 (of a hundred frames one) or '
             'silence=2/min:0.5-2']
    for name, kind in faults.KINDS.items():
        if faults.fits(name, board):
            lasts = ' (%g-%g s)' % kind.seconds if kind.seconds else ''
            lines.append('  %-10s %s%s' % (name, kind.text, lasts))
    mix = faults.MIXES[board].split()
    lines.append('  %-10s %s' % ('all', ' '.join(mix[:6])))
    lines += ['  %-10s %s' % ('', ' '.join(mix[at:at + 6])) for at in range(6, len(mix), 6)]
    return '\n'.join(lines)


def _port(text: str) -> str:
    try:
        check_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError('%s: %s' % (text, error)) from None
    if not text:
        raise argparse.ArgumentTypeError('is empty')
    return text


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError('%s is not above 0' % text)
    return value


def _max_length(text: str) -> int:
    value = int(text)
    if not 0 < value <= robot_ctrl_bus.MAX_LENGTH:
        raise argparse.ArgumentTypeError('%s is not 1 to %d' % (text, robot_ctrl_bus.MAX_LENGTH))
    return value
