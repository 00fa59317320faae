"""Shows every topic, link and call of the bridge, once a second: the live table of scripts/demo.

`Watcher` fills the table's state from ROS; `Moves` calls lift and gimbal and drives the car.
"""
import argparse
import math
import signal
import sys
import threading
import time
from typing import List, Optional, Tuple

import rosgraph
import rospy
from std_msgs.msg import String

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import Gimbal, Lift

from ...link.outcome import LOOK, Verdict
from ...output import prepare_output
from ...ros.answers import read_error, read_response
from ...ros.master import wait_for_master
from ...ros.rospy_mends.log_file import init_node
from ..watch.table import PERIOD, Screen
from ..watch.topics import LINKS, NODE
from ..watch.watcher import Watcher, leave
from .state import Commands, State

_START = 60.0           # s for the bridge to appear in
_CALL_EVERY = 3.0       # s from one lift or gimbal call to the next
_COMMAND_RATE = 10.0    # Hz of speed and steering

# Service, words, direction, amount, unit: there and back again, so that nothing ends at a stop.
_PLAN = (('lift', 'up', 0, 20, 'mm'), ('gimbal', 'left', 0, 15, 'degrees'),
         ('lift', 'down', 1, 20, 'mm'), ('gimbal', 'right', 1, 15, 'degrees'),
         ('lift', 'up', 0, 40, 'mm'), ('gimbal', 'up', 2, 10, 'degrees'),
         ('lift', 'down', 1, 40, 'mm'), ('gimbal', 'down', 3, 10, 'degrees'))


class Moves:
    """Calls lift and gimbal in turn and drives the car in gentle curves, until stopped."""

    def __init__(self, state: State) -> None:
        self._state = state
        self._stopping = threading.Event()
        self._threads = []
        if state.calls:
            self._threads.append(threading.Thread(target=self._call, daemon=True))
        if 'arduino' in state.bridge.links:
            self._threads.append(threading.Thread(target=self._drive, daemon=True))
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """The car stands; what is under way is left to end."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(0.5)

    def _call(self) -> None:
        proxies = {'lift': rospy.ServiceProxy(NODE + '/lift', Lift),
                   'gimbal': rospy.ServiceProxy(NODE + '/gimbal', Gimbal)}
        turn = 0
        while not self._stopping.is_set():
            name, words, direction, amount, unit = _PLAN[turn % len(_PLAN)]
            calls, asked = self._state.calls[name], time.monotonic()
            what = f'{words} {amount} {unit}'
            calls.words = f'{what}: ...'
            calls.answered(what, *_call(proxies[name], direction, amount),
                           time.monotonic() - asked)
            turn += 1
            self._stopping.wait(max(0.0, asked + _CALL_EVERY - time.monotonic()))

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
                if light != shown and led.get_num_connections() and not self._state.refusal():
                    led.publish(light)
                    shown = light
            except rospy.ROSException:
                return      # shutting down
            self._state.commands = Commands(now_speed, now_steering, shown)
        try:
            speed.publish(value=0)
        except rospy.ROSException:
            pass


def _call(proxy: rospy.ServiceProxy, direction: int, amount: int) -> Tuple[Verdict, str]:
    """Call a service: what became of it, and the words for that."""
    try:
        proxy.wait_for_service(_CALL_EVERY)
    except rospy.ROSException as error:
        return Verdict.REFUSED, f'nothing was sent: {error}'
    try:
        return read_response(proxy(direction, amount))
    except rospy.ServiceException as error:
        return read_error(error)
    except rospy.ROSException as error:
        return Verdict.NOT_KNOWN, f'{error}; {LOOK}'


def _arguments(argv: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description='Show what the bridge does, once a second.')
    parser.add_argument('--boards', default='real', help='what to call the boards')
    parser.add_argument('--links', nargs='+', choices=LINKS, default=LINKS, metavar='LINK',
                        help='the links that are on: ' + ', '.join(LINKS))
    parser.add_argument('--move', action='store_true',
                        help='move lift and gimbal and drive the car')
    parser.add_argument('--duration', type=float, metavar='SECONDS', help='end by itself')
    parser.add_argument('--setup', default='', help='the line that a second terminal needs')
    parser.add_argument('--page', default='', help="the panel's address")
    return parser.parse_args(argv)


def main(argv: Optional[List[str]] = None) -> int:
    """Show the table; 1 if, after --duration, something had not been shown to work."""
    prepare_output()
    options = _arguments(argv)
    state = State(options.boards, options.links, options.move, options.setup,
                  rosgraph.get_master_uri(), options.page)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    if not wait_for_master(stopping, patience=_START):
        if stopping.is_set():
            return 0
        print('table: there is no ROS master', file=sys.stderr)
        return 1

    init_node('live_table', anonymous=True, disable_signals=True)
    watcher = Watcher(state.bridge)
    watcher.start()
    deadline = time.monotonic() + _START
    # Boards of our own are waited for, since emulated ones are built first.
    while not stopping.is_set() and not (state.links_open() if options.boards != 'real'
                                         else state.bridge.said_at() is not None):
        if time.monotonic() > deadline:
            if state.bridge.said_at() is not None:
                break
            print(f'table: the bridge has said nothing for {_START:.0f} s', file=sys.stderr)
            return 1
        stopping.wait(0.1)
    screen = Screen()
    moves = Moves(state) if options.move and not stopping.is_set() else None
    try:
        _show(state, watcher, screen, options.duration, stopping)
    finally:
        if moves:
            moves.stop()
        screen.close(state.bridge, state.frame(), time.monotonic())
        leave()
    return _judge(state) if options.duration and not stopping.is_set() else 0


def _show(state: State, watcher: Watcher, screen: Screen, duration: Optional[float],
          stopping: threading.Event) -> None:
    began = due = time.monotonic()
    while not stopping.is_set():
        now = time.monotonic()
        state.elapsed = now - began
        watcher.update(now)
        screen.draw(state.bridge, state.frame(), now)
        if duration and state.elapsed >= duration:
            return
        due = max(due + PERIOD, now)
        if duration:
            due = min(due, began + duration)
        stopping.wait(max(0.0, due - time.monotonic()))


def _judge(state: State) -> int:
    optional = [each.topic.name for each in state.bridge.topics
                if each.topic.optional and not each.count]
    missing = state.missing()
    if missing:
        print(f'Missing after {state.elapsed:.0f} s:')
        print('\n'.join('  ' + each for each in missing))
        return 1
    calls = ', and lift and gimbal answered with success' if state.calls else ''
    boards = f" ({', '.join(optional)} is for ADC boards only)" if optional else ''
    print(f'Every topic carried data{calls}{boards}.')
    trouble = state.trouble()
    if trouble:
        print('But at the end not every link was OK:')
        print('\n'.join('  ' + each for each in trouble))
    return 0


if __name__ == '__main__':
    sys.exit(main())
