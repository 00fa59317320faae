"""Shows every topic, link and call of the bridge, once a second: the live table of scripts/demo.

`Watch` fills the table's state from ROS; `Moves` calls lift and gimbal and drives the car. Topics
are counted as they come, but only the last message of each is unpacked, once a redraw.
"""
import argparse
import math
import signal
import sys
import threading
import time
from typing import Any, Dict, List, Optional

import rosgraph
import roslib.message
import rospy
from std_msgs.msg import String

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import Gimbal, Lift

from .table import PERIOD, LinkState, Screen, State, TopicState
from .topics import LINKS, NODE

_START = 60.0           # s for the bridge to appear in
_CALL_EVERY = 3.0       # s from one lift or gimbal call to the next
_COMMAND_RATE = 10.0    # Hz of speed and steering


class Watch:
    """Subscribes to everything and brings a state up to date."""

    def __init__(self, state: State) -> None:
        self.alive = threading.Event()       # the bridge has spoken
        self._state = state
        self._latest: Dict[str, bytes] = {}
        self._classes = {each.topic.name: roslib.message.get_message_class(each.topic.type)
                         for each in state.topics}
        self._subscribers = [rospy.Subscriber(each.topic.name.replace('~', NODE + '/'),
                                              rospy.AnyMsg, self._take, each, tcp_nodelay=True,
                                              buff_size=1 << 18) for each in state.topics]

    def _take(self, message: Any, each: TopicState) -> None:
        self._latest[each.topic.name] = message._buff
        each.count += 1
        if each.topic.name == '/diagnostics':    # each message is about one link
            self._take_links(self._classes[each.topic.name]().deserialize(message._buff))

    def _take_links(self, message: Any) -> None:
        for status in message.status:
            prefix, _, name = status.name.partition(': ')
            if prefix == NODE and name.endswith(' link'):
                self._state.links[name[:-len(' link')]] = LinkState(
                    status.level, status.message,
                    {pair.key: pair.value for pair in status.values})
                self.alive.set()

    def links_open(self) -> bool:
        """Whether every link has said that its port is open and its board answers."""
        links = self._state.links
        return all(name in links and links[name].level < 2 for name in self._state.on)

    def update(self, now: float) -> None:
        """Rates and last values."""
        for each in self._state.topics:
            each.measure(now)
            packed = self._latest.pop(each.topic.name, None)
            if packed is not None:
                try:
                    each.words = each.topic.words(
                        self._classes[each.topic.name]().deserialize(packed))
                except Exception as error:   # whatever another publisher may send
                    each.words = 'not as expected: %s' % error


class Moves:
    """Calls lift and gimbal in turn and drives the car in gentle curves, until stopped."""

    def __init__(self, state: State) -> None:
        self._state = state
        self._stopping = threading.Event()
        self._threads = []
        if state.calls:
            self._threads.append(threading.Thread(target=self._call, daemon=True))
        if 'arduino' in state.on:
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
        # There and back again, so that nothing ends at a stop.
        plan = (('lift', 'up', 0, 20, 'mm'), ('gimbal', 'left', 0, 15, 'degrees'),
                ('lift', 'down', 1, 20, 'mm'), ('gimbal', 'right', 1, 15, 'degrees'),
                ('lift', 'up', 0, 40, 'mm'), ('gimbal', 'up', 2, 10, 'degrees'),
                ('lift', 'down', 1, 40, 'mm'), ('gimbal', 'down', 3, 10, 'degrees'))
        while not self._stopping.is_set():
            name, words, direction, amount, unit = plan[turn % len(plan)]
            call, asked = self._state.calls[name], time.monotonic()
            what = '%s %d %s: ' % (words, amount, unit)
            call.words = what + '...'
            try:
                proxies[name].wait_for_service(_CALL_EVERY)
                answer = proxies[name](direction, amount)
                succeeded, said = answer.success, answer.message
            except (rospy.ROSException, rospy.ServiceException) as error:
                succeeded, said = False, str(error)
            call.succeeded += succeeded
            call.failed += not succeeded
            call.words = '%s%s, after %.2f s (%d done, %d not)' % (
                what, said, time.monotonic() - asked, call.succeeded, call.failed)
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
                if light != shown and led.get_num_connections():
                    led.publish(light)
                    shown = light
            except rospy.ROSException:
                return      # shutting down
            self._state.commands = '~speed %d, ~steering %d, ~led %s' % (
                now_speed, now_steering, shown or '-')
        try:
            speed.publish(value=0)
        except rospy.ROSException:
            pass


def _wait_for_master(stopping: threading.Event) -> bool:
    deadline = time.monotonic() + _START
    while not rosgraph.is_master_online():
        if time.monotonic() > deadline or stopping.wait(0.2):
            return False
    return True


def _arguments(argv: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description='Show what the bridge does, once a second.')
    parser.add_argument('--boards', default='real', help='what to call the boards')
    parser.add_argument('--links', nargs='+', choices=LINKS, default=LINKS, metavar='LINK',
                        help='the links that are on: bus, arduino, mcu')
    parser.add_argument('--move', action='store_true',
                        help='move lift and gimbal and drive the car')
    parser.add_argument('--duration', type=float, metavar='SECONDS', help='end by itself')
    parser.add_argument('--setup', default='', help='the line that a second terminal needs')
    return parser.parse_args(argv)


def main(argv: Optional[List[str]] = None) -> int:
    """Show the table; 1 if, after --duration, something had not been shown to work."""
    options = _arguments(argv)
    links = tuple(name for name in LINKS if name in options.links)
    state = State(options.boards, links, options.move, options.setup)
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    if not _wait_for_master(stopping):
        if stopping.is_set():
            return 0
        print('table: there is no ROS master', file=sys.stderr)
        return 1

    rospy.init_node('live_table', anonymous=True, disable_signals=True)
    watch = Watch(state)
    deadline = time.monotonic() + _START
    # Boards of our own are waited for, since emulated ones are built first.
    while not stopping.is_set() and not (watch.links_open() if options.boards != 'real'
                                         else watch.alive.is_set()):
        if time.monotonic() > deadline:
            if watch.alive.is_set():
                break
            print('table: the bridge has said nothing for %d s' % _START, file=sys.stderr)
            return 1
        stopping.wait(0.1)
    screen = Screen()
    moves = Moves(state) if options.move else None
    try:
        _show(state, watch, screen, options.duration, stopping)
    finally:
        if moves:
            moves.stop()
        screen.close(state)
        rospy.signal_shutdown('the table ends')
    return _judge(state) if options.duration and not stopping.is_set() else 0


def _show(state: State, watch: Watch, screen: Screen, duration: Optional[float],
          stopping: threading.Event) -> None:
    began = due = time.monotonic()
    while not stopping.is_set():
        now = time.monotonic()
        state.elapsed = now - began
        watch.update(now)
        screen.draw(state)
        if duration and state.elapsed >= duration:
            return
        due = max(due + PERIOD, now)
        if duration:
            due = min(due, began + duration)
        stopping.wait(max(0.0, due - time.monotonic()))


def _judge(state: State) -> int:
    optional = [each.topic.name for each in state.topics
                if each.topic.optional and not each.count]
    missing = state.missing()
    if missing:
        print('Missing after %d s:' % state.elapsed)
        print('\n'.join('  ' + each for each in missing))
        return 1
    print('Every topic carried data%s%s.' % (
        ', and lift and gimbal answered with success' if state.calls else '',
        ' (%s is for ADC boards only)' % ', '.join(optional) if optional else ''))
    return 0


if __name__ == '__main__':
    sys.exit(main())
