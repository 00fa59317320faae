"""The live table of scripts/demo: every topic, link and call of the bridge, once a second.

The table is the monitor's. `Moves` calls lift and gimbal and drives the car.
"""
import argparse
import itertools
import math
import sys
import threading
import time
from typing import List, Optional

import rosgraph
import rospy
from std_msgs.msg import String

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import Gimbal, Lift

from ...output import end_with_output, prepare_output
from ..watch.calls import call
from ..watch.live import LiveTable, stopped_by_signals
from ..watch.master import wait_for_master
from ..watch.topics import LINKS, NODE
from .state import Demo, PageAddress

_START = 60.0           # s for the bridge to start
_CALL_EVERY = 3.0       # s between two lift or gimbal calls
_COMMAND_RATE = 10.0    # Hz of speed and steering

# Service, words, direction, amount, unit. Each move is undone, so that none runs into an end stop.
_PLAN = ((Lift, 'up', 0, 20, 'mm'), (Gimbal, 'left', 0, 15, 'degrees'),
         (Lift, 'down', 1, 20, 'mm'), (Gimbal, 'right', 1, 15, 'degrees'),
         (Lift, 'up', 0, 40, 'mm'), (Gimbal, 'up', 2, 10, 'degrees'),
         (Lift, 'down', 1, 40, 'mm'), (Gimbal, 'down', 3, 10, 'degrees'))


class Moves:
    """Calls lift and gimbal in turn and drives the car in gentle curves, until stopped."""

    def __init__(self, demo: Demo) -> None:
        self._demo = demo
        self._stopping = threading.Event()
        self._threads = [threading.Thread(target=run, daemon=True) for run, can in (
            (self._call, demo.calls), (self._drive, 'arduino' in demo.bridge.links)) if can]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Send SPEED 0 and make no further calls. A call under way is not cancelled."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(0.5)

    def _call(self) -> None:
        for service, words, direction, amount, unit in itertools.cycle(_PLAN):
            name, asked = service.__name__.lower(), time.monotonic()
            calls, what = self._demo.calls[name], f'{words} {amount} {unit}'
            calls.words = f'{what}: ...'
            answer = call(f'{NODE}/{name}', service, service._request_class(direction, amount),
                          asked + _CALL_EVERY)
            calls.answered(what, answer.outcome, answer.words, time.monotonic() - asked)
            if self._stopping.wait(max(0.0, asked + _CALL_EVERY - time.monotonic())):
                return

    def _drive(self) -> None:
        speed = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=1)
        steering = rospy.Publisher(NODE + '/steering', SteeringPWMCommand, queue_size=1)
        led = rospy.Publisher(NODE + '/led', String, queue_size=1)
        began, shown = time.monotonic(), ''
        while not self._stopping.wait(1 / _COMMAND_RATE):
            t = time.monotonic() - began
            curve = math.sin(t * 2 * math.pi / 20)
            now_speed, now_steering = round(300 + 100 * math.sin(t / 4)), round(1500 + 200 * curve)
            light = 'left' if curve < -0.5 else 'right' if curve > 0.5 else 'disable'
            try:
                speed.publish(value=now_speed)
                steering.publish(value=now_steering)
                if light != shown and led.get_num_connections() and not self._demo.refusal():
                    led.publish(light)
                    shown = light
            except rospy.ROSException:
                return      # shutting down
            self._demo.driving = (f'~speed {now_speed}, ~steering {now_steering}, '
                                  f"~led {shown or '-'}")
        try:
            speed.publish(value=0)
        except rospy.ROSException:
            pass


def _arguments(argv: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description='Show what the bridge does, once a second.')
    parser.add_argument('--boards', default='real', help='what to call the boards')
    parser.add_argument('--links', nargs='+', choices=LINKS, default=LINKS, metavar='LINK',
                        help='the links that are on, of: ' + ', '.join(LINKS))
    parser.add_argument('--move', action='store_true',
                        help='move lift and gimbal and drive the car')
    parser.add_argument('--control', action='store_true', help='the page has commands')
    parser.add_argument('--duration', type=float, metavar='SECONDS', help='end after this time')
    parser.add_argument('--setup', default='', help='the command that sets up a second terminal')
    parser.add_argument('--page-log', help='the file in which the panel prints its addresses')
    return parser.parse_args(argv)


def main(argv: Optional[List[str]] = None) -> int:
    """Show the table. Return the exit status: 1 if something is missing after --duration."""
    prepare_output()
    options = _arguments(argv)
    return end_with_output(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    demo = Demo(options.boards, options.links, options.move, options.setup,
                rosgraph.get_master_uri(), options.page_log and PageAddress(options.page_log),
                options.control)
    stopping = stopped_by_signals()
    if not wait_for_master(stopping, patience=_START):
        if stopping.is_set():
            return 0
        print('table: there is no ROS master', file=sys.stderr)
        return 1

    table = LiveTable('live_table', demo.bridge, demo.heading)
    deadline = time.monotonic() + _START
    # Simulated boards are waited for, since the emulated ones are built first.
    while not stopping.is_set() and not (demo.links_open() if options.boards != 'real'
                                         else demo.bridge.reported_at() is not None):
        if time.monotonic() > deadline:
            if demo.bridge.reported_at() is not None:
                break
            print(f'table: the bridge has reported nothing for {_START:.0f} s; see its log',
                  file=sys.stderr)
            return 1
        stopping.wait(0.1)
    moves = Moves(demo) if options.move and not stopping.is_set() else None
    try:
        try:
            table.run(stopping, options.duration)
        finally:
            if moves:
                moves.stop()
        table.close()
    finally:
        rospy.signal_shutdown('it ends')
    return _result(demo, table.elapsed) if options.duration and not stopping.is_set() else 0


def _result(demo: Demo, elapsed: float) -> int:
    optional = [each.topic.name for each in demo.bridge.topics
                if each.topic.optional and not each.count]
    missing = demo.missing()
    if missing:
        print('\n  '.join([f'Missing after {elapsed:.0f} s:', *missing]))
        return 1
    calls = ', and lift and gimbal answered with success' if demo.calls else ''
    boards = f" ({', '.join(optional)} is for ADC boards only)" if optional else ''
    print(f'Every topic carried data{calls}{boards}.')
    trouble = demo.trouble()
    if trouble:
        print('\n  '.join(['But at the end not every link was OK:', *trouble]))
    return 0


if __name__ == '__main__':
    sys.exit(main())
