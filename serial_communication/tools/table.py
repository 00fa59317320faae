"""The live table of scripts/demo: every topic, link and call of the bridge, once a second.

The layout is a pure function from a `State` to lines of text; `Watch` fills the state from ROS,
`Moves` calls lift and gimbal and drives the car, and `Screen` puts the lines where they belong.
Topics are counted as they come, but only the last message of each is unpacked, once a redraw.
"""
import argparse
import math
import shutil
import signal
import sys
import threading
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, List, NamedTuple, Optional, Tuple

LINKS = ('bus', 'arduino', 'mcu')
_NODE = 'serial_communication'
_START = 60.0           # s for the bridge to appear in
_PERIOD = 1.0           # s from one redraw to the next
_PLAIN_EVERY = 5        # redraws to one report, where the output is no terminal
_RATE_WINDOW = 5.0      # s over which a rate is counted
_CALL_EVERY = 3.0       # s from one lift or gimbal call to the next
_COMMAND_RATE = 10.0    # Hz of speed and steering
_VALUE_AT = 36          # column of a topic's value


# -- values in words ---------------------------------------------------------------------------


def _angles(orientation: Any) -> str:
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return 'rpy %.1f %.1f %.1f deg' % (
        math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
        math.degrees(math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))),
        math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))


def _acceleration(imu: Any) -> str:
    a = imu.linear_acceleration
    return ', %.2f %.2f %.2f m/s^2' % (a.x, a.y, a.z)


def _range(message: Any) -> str:
    if math.isnan(message.range):
        return 'no reading'
    if math.isinf(message.range):
        return 'nearer than %.2f m' % message.min_range if message.range < 0 else \
            'farther than %.2f m' % message.max_range
    return '%.3f m' % message.range


def _traffic(message: Any) -> str:
    return '%s %s %s' % (message.link, 'sent' if message.direction else 'received',
                         message.error or message.text)


def _health(message: Any) -> str:
    if not message.connected:
        return 'silent for %.1f s' % message.last_frame_age_sec
    return '%s, %d CRC errors, seq %d' % (
        'valid' if message.valid else 'NOT valid', message.crc_error_count, message.seq)


def _sensor_status(message: Any) -> str:
    if not message.connected:
        return _health(message)
    return '%d and %d mm, yaw %.1f deg, %s' % (message.vl53_1, message.vl53_2, message.yaw,
                                               _health(message))


def _adc_status(message: Any) -> str:
    return '%s, %s' % (_health(message), ' '.join(
        str(getattr(message, 'adc%d' % channel)) for channel in range(6)))


def _frames(message: Any) -> str:
    return ', '.join('%s in %s' % (each.child_frame_id, each.header.frame_id)
                     for each in message.transforms)


class Topic(NamedTuple):
    """A topic that the bridge publishes: ~ stands for its private names."""

    name: str
    type: str                        # as ROS has it: package/Type
    links: Tuple[str, ...]           # it carries data if one of these links is on
    words: Callable[[Any], str]      # the last message, for a person
    optional: bool = False           # only some boards send it


TOPICS = (
    Topic('serial_msg', _NODE + '/SerialMsg', LINKS, _traffic),
    Topic('~imu', 'sensor_msgs/Imu', ('arduino',),
          lambda m: _angles(m.orientation) + _acceleration(m)),
    Topic('~imu/temperature', 'sensor_msgs/Temperature', ('arduino',),
          lambda m: '%.1f degrees C' % m.temperature),
    Topic('~imu/calibrating', 'std_msgs/Bool', ('arduino',),
          lambda m: 'yes' if m.data else 'no'),
    Topic('~voltage', _NODE + '/Voltage', ('arduino',), lambda m: '%.2f V' % m.value),
    Topic('~ticks', _NODE + '/Ticks', ('arduino',), lambda m: '%d in 10 ms' % m.value),
    Topic('~steering_angle', _NODE + '/SteeringFeedback', ('arduino',),
          lambda m: '%d of 1024' % m.value),
    Topic('~environment', _NODE + '/Environment', ('bus',), lambda m: 'smoke %d, %.2f degrees C, '
          '%.2f %%' % (m.smoke, m.temperature, m.humidity)),
    Topic('~environment/temperature', 'sensor_msgs/Temperature', ('bus',),
          lambda m: '%.2f degrees C' % m.temperature),
    Topic('~environment/humidity', 'sensor_msgs/RelativeHumidity', ('bus',),
          lambda m: '%.2f %%' % (m.relative_humidity * 100)),
    Topic('mcu/status', _NODE + '/McuStatus2', ('mcu',), _sensor_status),
    Topic('mcu/adc_status', _NODE + '/McuStatus', ('mcu',), _adc_status, optional=True),
    Topic('mcu/imu', 'sensor_msgs/Imu', ('mcu',), lambda m: _angles(m.orientation)),
    Topic('mcu/range_1', 'sensor_msgs/Range', ('mcu',), _range),
    Topic('mcu/range_2', 'sensor_msgs/Range', ('mcu',), _range),
    Topic('/tf', 'tf2_msgs/TFMessage', ('arduino', 'mcu'), _frames),
    Topic('/tf_static', 'tf2_msgs/TFMessage', ('arduino', 'mcu'), _frames),
    Topic('/diagnostics', 'diagnostic_msgs/DiagnosticArray', LINKS,
          lambda m: '; '.join('%s: %s' % (each.name, each.message) for each in m.status)),
)


# -- what the table shows ------------------------------------------------------------------


class TopicState:
    """What has come on one topic."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.count = 0
        self.rate: Optional[float] = None    # Hz; None: not known yet
        self.words = ''
        self._counted: Deque[Tuple[float, int]] = deque()

    def measure(self, now: float) -> None:
        """To be called at every redraw: the rate over the last few seconds."""
        self._counted.append((now, self.count))
        while now - self._counted[0][0] > _RATE_WINDOW + _PERIOD / 2:
            self._counted.popleft()
        began, count = self._counted[0]
        self.rate = (self.count - count) / (now - began) if now > began else None


class LinkState(NamedTuple):
    """What /diagnostics says about one link."""

    level: int
    summary: str
    values: Dict[str, str]


class Call:
    """The latest call of one service."""

    def __init__(self) -> None:
        self.words = 'not called yet'
        self.succeeded = 0
        self.failed = 0


class State:
    """All that the table shows."""

    def __init__(self, boards: str = 'simulated', links: Tuple[str, ...] = LINKS,
                 moves: bool = True, setup: str = '') -> None:
        self.boards = boards
        self.on = links
        self.moves = moves
        self.setup = setup           # the line that a second terminal needs
        self.elapsed = 0.0           # s
        self.topics = [TopicState(topic) for topic in TOPICS if set(topic.links) & set(links)]
        self.links: Dict[str, LinkState] = {}
        self.calls = {'lift': Call(), 'gimbal': Call()} if moves and 'bus' in links else {}
        self.commands = ''           # the latest, to the car

    def missing(self) -> List[str]:
        """What has not been shown to work, in words; empty if everything has."""
        out = ['no data on %s' % each.topic.name for each in self.topics
               if not each.count and not each.topic.optional]
        for name, call in self.calls.items():
            if not call.succeeded:
                out.append('no successful answer from %s: %s' % (name, call.words))
        return out


class Line(NamedTuple):
    """A line of the table, and how it looks: plain, head, good, warn or bad."""

    text: str
    style: str = 'plain'


def layout(state: State, width: int = 80, height: int = 24) -> List[Line]:
    """The table, at most `width` by `height`; blank lines and headings only where there is room."""
    blocks = [[Line('%s boards, %d s.  ~ is /%s/  Ctrl-C ends it.' % (
        state.boards.capitalize(), state.elapsed, _NODE), 'head')]]
    if state.setup:
        blocks[0].append(Line('In another terminal:  ' + state.setup))
    shown = [each for each in state.topics if each.count or not each.topic.optional]
    blocks.append([Line('%-24s %9s  %s' % ('topic', 'rate', 'last value'), 'head')])
    blocks[-1] += [_topic_line(each) for each in shown]
    blocks.append([Line('link', 'head')])
    blocks[-1] += [_link_line(name, state.links.get(name)) for name in state.on]
    blocks.append([Line('commands', 'head')])
    blocks[-1] += [Line('%-8s%s' % (name, call.words), 'plain' if call.succeeded or
                        not call.failed else 'bad') for name, call in state.calls.items()]
    if state.commands:
        blocks[-1].append(Line('%-8s%s' % ('car', state.commands)))
    if len(blocks[-1]) == 1:
        blocks[-1].append(Line('none: real boards are only looked at'))
    lines = _stack(blocks, height)
    return [Line(text[:width], style) for text, style in lines[:height]]


def _stack(blocks: List[List[Line]], height: int) -> List[Line]:
    """One below the other, as airy as the height allows; at last two topics share a line."""
    title, topics, links, commands = blocks
    needed = sum(len(block) for block in blocks)
    if needed + 3 <= height:
        gap = [Line('')]
        return title + gap + topics + gap + links + gap + commands
    if needed <= height:
        return title + topics + links + commands
    short = title + topics[1:] + links[1:] + commands[1:]
    for pair in (('/tf', '/tf_static'), ('mcu/range_1', 'mcu/range_2'),
                 ('~environment/temperature', '~environment/humidity')):
        if len(short) > height:
            short = _join(short, pair)
    return short


def _join(lines: List[Line], names: Tuple[str, str]) -> List[Line]:
    """The lines of these two topics, which follow each other, as one line."""
    at = next((index for index, line in enumerate(lines)
               if line.text.split(' ')[0] == names[0]), None)
    if at is None:
        return lines
    one, other = lines[at:at + 2]
    text = '%s, %s%s; %s' % (names[0], names[1].split('/')[-1],
                             one.text[len(names[0]):][len(names[1].split('/')[-1]) + 2:],
                             other.text[_VALUE_AT:])
    return lines[:at] + [Line(text, one.style if one.style != 'plain' else other.style)] \
        + lines[at + 2:]


def _topic_line(each: TopicState) -> Line:
    rate = '-'
    if each.rate:
        rate = '%.1f Hz' % each.rate
    elif each.count == 1:
        rate = 'once'
    elif each.rate == 0.0 and each.count:
        rate = 'paused'
    text = '%-24s %9s  %s' % (each.topic.name, rate, each.words or 'nothing yet')
    return Line(text, 'plain' if each.count else 'warn')


def _link_line(name: str, link: Optional[LinkState]) -> Line:
    if link is None:
        return Line('%-8s no word from it yet' % name, 'warn')
    values = link.values.get
    damaged = sum(int(value) for key, value in link.values.items()
                  if key.endswith(' errors') and value.isdigit())
    parts = ['%-8s%-5s %s' % (name, ('OK', 'WARN', 'ERROR', 'STALE')[min(link.level, 3)],
                              link.summary),
             'in %s' % values('frames received', '-'), 'out %s' % values('frames sent', '-'),
             'bad %d' % damaged]
    for key, words in (('heartbeats sent', 'heartbeats %s'),
                       ('heartbeat max gap [ms]', 'max gap %s ms'),
                       ('timeouts', 'timeouts %s'), ('round trip p50 [ms]', 'round trip %s ms'),
                       ('frames lost', 'lost %s'), ('reconnects', 'reconnects %s')):
        if key in link.values and not (key == 'reconnects' and values(key) == '0'):
            parts.append(words % values(key))
    return Line(', '.join(parts), ('good', 'warn', 'bad', 'bad')[min(link.level, 3)])


def report(state: State) -> List[str]:
    """A few plain lines, where there is no terminal to redraw."""
    wanted = [each for each in state.topics if not each.topic.optional]
    rates = ['%s %.1f Hz' % (each.topic.name, each.rate) for each in wanted
             if each.rate and each.topic.name in ('~imu', '~environment', 'mcu/status')]
    lines = ['[%3d s] %s' % (state.elapsed, ', '.join(['%d of %d topics carry data' % (
        sum(bool(each.count) for each in wanted), len(wanted))] + rates))]
    lines += ['        ' + _link_line(name, state.links.get(name)).text for name in state.on]
    lines += ['        %-8s%s' % (name, call.words) for name, call in state.calls.items()]
    return lines


# -- the terminal --------------------------------------------------------------------------


class Screen:
    """Redraws in place on a terminal; prints a report now and then elsewhere."""

    _STYLES = {'plain': '', 'head': '\033[1m', 'good': '\033[32m', 'warn': '\033[33m',
               'bad': '\033[31m'}

    def __init__(self, out: Any = sys.stdout) -> None:
        self._out = out
        self._terminal = out.isatty()
        self._draws = 0
        if hasattr(out, 'reconfigure'):
            out.reconfigure(errors='replace')    # whatever the locale can print

    def draw(self, state: State) -> None:
        """Show the state as it is now."""
        self._draws += 1
        if self._terminal:
            size = shutil.get_terminal_size()
            # Each line is written over the old one, never wiped first, in one write: no flicker.
            lines = ['%s%s\033[0m\033[K' % (self._STYLES[style], text) for text, style
                     in layout(state, size.columns, size.lines)]
            begin = '\033[?25l\033[2J\033[H' if self._draws == 1 else '\033[H'
            self._write(begin + '\r\n'.join(lines) + '\033[J')
        elif self._draws % _PLAIN_EVERY == 1:
            self._write('\n'.join(report(state)) + '\n')

    def close(self, state: State) -> None:
        """Leave the last table behind and give the terminal back."""
        if self._terminal:
            if self._draws:
                self._write('\033[0m\033[?25h\r\n')
        else:
            lines = layout(state, 160, 100)
            self._write('\n'.join(line.text.rstrip() for line in lines) + '\n')

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()


# -- ROS -----------------------------------------------------------------------------------


class Watch:
    """Subscribes to everything and brings a state up to date."""

    def __init__(self, state: State) -> None:
        import roslib.message
        import rospy
        self.alive = threading.Event()       # the bridge has spoken
        self._state = state
        self._latest: Dict[str, bytes] = {}
        self._classes = {each.topic.name: roslib.message.get_message_class(each.topic.type)
                         for each in state.topics}
        self._subscribers = [rospy.Subscriber(each.topic.name.replace('~', _NODE + '/'),
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
            if prefix == _NODE and name.endswith(' link'):
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
        import rospy
        from serial_communication.srv import Gimbal, Lift
        proxies = {'lift': rospy.ServiceProxy(_NODE + '/lift', Lift),
                   'gimbal': rospy.ServiceProxy(_NODE + '/gimbal', Gimbal)}
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
        import rospy
        from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
        from std_msgs.msg import String
        speed = rospy.Publisher(_NODE + '/speed', SpeedPWMCommand, queue_size=1)
        steering = rospy.Publisher(_NODE + '/steering', SteeringPWMCommand, queue_size=1)
        led = rospy.Publisher(_NODE + '/led', String, queue_size=1)
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
    import rosgraph
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

    import rospy
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
        due = max(due + _PERIOD, now)
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
