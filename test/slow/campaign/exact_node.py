"""The node, exactly: what happens to its process, and to others that it works with."""
import contextlib
import fcntl
import glob
import json
import os
import signal
import termios
import time
import xmlrpc.client
from typing import Any, Dict, FrozenSet, List, Tuple

import rosgraph
import rospy
from dynamic_reconfigure.msg import Config, IntParameter
from dynamic_reconfigure.srv import Reconfigure
from sensor_msgs.msg import Temperature
from std_msgs.msg import Header, UInt8

import by_definition as codec
from processes import StageError
from .boards import CUSTOM, PERIODS, POLLED, Reaction
from .exact_car import STAMPED, TYPES, Drive, check_first, check_timeout
from .exact_data import REPORTED, at_rest, measurements, opened, unknown_types
from .exact_faults import PORT_RETURN, PORT_RETURNS
from .rig import AFTER, LATCHED, Rig
from .robot import NODE

_END = 2.0               # s
_ABSENT = 9.0            # s until a port appears
_MASTER_RETURN = 10.0    # s
_ENDS = 'it ends within 2 s, whatever hangs; last packet SPEED 0'
_TRIES = 20
_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
# The last two rows conflict with parameters: with a name, and a type.
_HOIST = (b'hoist: {type: %d, direction: to_board, ros_type: sensor_msgs/Temperature, '
          b'layout: <, fields: []}')
_TEXT = (b'firmware: campaign %d\n' + _HOIST + b'\ngauge: {type: %d, ros_type: std_msgs/UInt8, '
         b'layout: <B, fields: [data]}\n'
         b'winch: {type: 200, ros_type: std_msgs/UInt8, layout: <B, fields: [data]}\n'
         b'second: {type: 60, ros_type: std_msgs/UInt8, layout: <B, fields: [data]}')
_NEW_MASTER, _ANNOUNCES = 'is a new ROS master', 'arduino: announces'      # in the log
_LEVEL = 90
_LEVELS = b'\n'.join(       # as many rows as one text may have
    b'level_%d: {type: %d, ros_type: std_msgs/UInt8, layout: <B, fields: [data]}' % (n, _LEVEL + n)
    for n in range(16))
_NONSENSE = b'', b'\0\1\0\0{[', *(bytes((number,)) * 40 for number in range(256))
POLLING: Dict[str, Any] = {
    'bus/environment_period': PERIODS[codec.ENVIRONMENT], 'bus/announcements': True,
    'bus/functions': json.dumps({**CUSTOM['bus/functions'], **POLLED})}


def second_bridge(rig: Rig) -> None:
    """Another bridge with the same name is started."""
    required = rig.row('a second bridge with the same name ends; the first continues')
    second = rig.child('second', [*rig.bridge_command, f'__name:={NODE[1:]}'])
    required.wait(lambda: not second.alive, 'it ends')
    required.check(second.process.returncode == 3, f'exit status {second.process.returncode}')
    uri = rosgraph.Master('/campaign').lookupNode(NODE)
    required.check(xmlrpc.client.ServerProxy(uri).getPid('/campaign')[2] == rig.child_bridge.pid,
                   'the second one is registered at the master')
    Drive(rig).command()
    locked = rig.row('an open port is locked against other programs')
    with opened(rig.mcu_line.port) as port:
        try:
            fcntl.flock(port, fcntl.LOCK_EX | fcntl.LOCK_NB)
            locked.check(False, 'another program can lock it')
        except BlockingIOError:
            locked.check(True, '')


def mistakes(rig: Rig) -> None:
    """Nodes are started with one port for two links, one name for two topics, wrong values, and an
    argument. Each says what is wrong."""
    required = rig.row('a mistake in its configuration ends a node with status 1 or 2')
    alias = rig.path(f'alias_{time.monotonic_ns()}')
    os.symlink(rig.car_line.port, alias)
    absent, row = f'_mcu/port:={rig.path("absent")}', '{ros_type: std_msgs/UInt8, layout: <B, '
    for status, words, arguments in (
            (1, 'which is also the port of',
             [f'_arduino/port:={rig.car_line.port}', f'_bus/port:={alias}']),
            (1, '/mcu/range_2', [absent, 'mcu/range_1:=mcu/range_2']),
            (1, 'mcu/timeout is True', [absent, '_mcu/timeout:=true']),
            (1, 'arduino/heartbeat_rate is 0', [absent, '_arduino/heartbeat_rate:=0']),
            (1, 'boards', [absent, '_boards:=[nowhere]']),
            (1, 'mcu/messages/low/type is 1',
             [absent, '_mcu/messages:={low: %stype: 1, fields: [data]}}' % row]),
            (1, 'has no field date', [absent, '_mcu/messages:={low: %stype: 40, fields: [date]}}'
                                      % row]),
            (2, 'unknown argument', ['__log:=/dev/null', 'wrong'])):
        name = f'mistake_{time.monotonic_ns()}'     # without parameters of another one
        node = rig.child(name, [*rig.bridge_command, f'__name:={name}', *arguments])
        required.wait(lambda: not node.alive, f'with {arguments} it ends')
        required.check(node.process.returncode == status and words in node.tail(),
                       f'{arguments}: exit status {node.process.returncode}, {node.tail()}')


def suspended_subscriber(rig: Rig) -> None:
    """SIGSTOP of a subscriber of all topics."""
    child = rig.user('subscriber', 'suspended_subscriber', *rig.robot.topics)
    child.hold()
    at_rest(rig)
    measurements(rig)
    rig.end(child)


def new_master(rig: Rig) -> None:
    """roscore ends, and another one starts at its address: the bridge starts again."""
    returns = rig.row('topics, services, parameters return within 10 s of a new master')
    continues = rig.row('without a master the ports stay open and commands arrive')
    before, parameters = _registered(), rospy.get_param(NODE)
    connections = rig.car.connection, rig.bus.connection, rig.sensors.connection
    drive, known = Drive(rig), len(rig.logs.find(_NEW_MASTER))
    rig.ask_master_to_end()
    rig.wait(lambda: not rig.master_runs, 'the master has ended')
    drive.command()
    rig.end_master()
    continues.check((rig.car.connection, rig.bus.connection, rig.sensors.connection)
                    == connections, 'a port was opened again')
    with rig.suspended():       # what is there before the bridge finds the new master
        rig.start_master()
        rospy.set_param(f'{NODE}/bus/retries', 3)
        early = rig.user('numbers', f'early_{time.monotonic_ns()}', 5000)
    parameters['bus']['retries'] = 3
    began = time.monotonic()
    rig.row('what happened is in the log').wait(
        lambda: len(rig.logs.find(_NEW_MASTER)) > known, 'that the master is a new one', 10.0)
    rig.wait(lambda: rig.car.last.is_stop, 'the last packet is SPEED 0')
    for board in rig.car, rig.bus:      # a pty does not show that the bridge starts again
        board.start_connection()
    returns.wait(lambda: _registered() >= before, 'all is registered')
    returns.at_most(time.monotonic() - began, _MASTER_RETURN, 's', 'all is registered')
    returns.wait(lambda: rospy.get_param(NODE) == parameters, 'the parameters are as before', 5.0)
    returns.wait(lambda: max(rig.car.commands(codec.STEERING), default=0) >= 5000,
                 'commands of a publisher that was there first')
    rig.end(early)
    rig.robot.register_again()
    rig.wait_for_bridge()
    Drive(rig).command()
    continues.check(rig.robot.call('lift', 0, 2).success, 'a call failed')


def _registered() -> FrozenSet[Tuple[str, str]]:
    """What the bridge has registered at the master; empty if there is no master."""
    master = rosgraph.Master('/campaign')
    try:
        names = [(str(kind), name) for kind, entries in enumerate(master.getSystemState())
                 for name, nodes in entries if NODE in nodes]
        return frozenset([*names, *(('parameter', key) for key in master.getParam(NODE))])
    except (OSError, rosgraph.MasterException):
        return frozenset()


def killed(rig: Rig) -> None:
    """SIGKILL while the car drives; then another bridge, an absent port, an old latched speed."""
    latched = rig.row(LATCHED)
    absent = rig.row('a port that is absent at the start is opened when it appears')
    drive = Drive(rig)
    number = drive.command().number
    child = rig.user('latching', 'early', 301, 302)
    rig.end(rig.child_bridge, signal.SIGKILL)
    rig.car_line.drain()
    rig.mcu_line.unplug()
    since, absent_since = len(rig.car.packets), time.monotonic()
    rig.robot.clear_records()
    rig.start(POLLING)
    check_first(rig)
    absent.wait(lambda: rig.robot.published['mcu/status'], 'a report before the first frame')
    child.order('next')
    for name, type_ in TYPES.items():
        latched.wait(lambda: rig.car.packet(type_, 302), f'the new {name} arrives')
        latched.check(not rig.car.packet(type_, 301, since), f'the latched {name} 301 arrived')
    drive.check_not_sent([number], 'from before SIGKILL', since)
    rig.end(child)
    rig.sleep(absent_since + _ABSENT - time.monotonic())
    began = time.monotonic()
    rig.mcu_line.plug()
    rig.wait_for_data('mcu/cliff', rig.sensors.cliff, absent)
    rig.in_time(rig.row(PORT_RETURNS), began, time.monotonic(), PORT_RETURN, 'absent at first')
    with rig.clock.each(0.05, rig.sensors.cliff):
        rig.sleep(0.2)
        rig.robot.clear_records()
        rig.sleep(2.5)
        rig.row(REPORTED).check(not rig.robot.published['mcu/status'],
                                'a report of a board that sends other frames')


def ends(rig: Rig) -> None:
    """A signal ends the bridge, twenty times: while the car drives and a call waits for its reply,
    or while the ports of bus and mcu take no bytes. Behind networks once."""
    required = rig.row(_ENDS)
    for index in range(1 if rig.is_network else 2 * _TRIES):
        _end(rig, _SIGNALS[index % 3], hang=index % 2 == 1, master_hangs=index % 8 == 7)
        rig.bus.usual()
        rig.start()
        if required.checks >= 3 * _TRIES:
            break


def _end(rig: Rig, number: int, hang: bool, master_hangs: bool) -> None:
    """End the bridge with this signal."""
    required, what = rig.row(_ENDS), f'{signal.Signals(number).name}{", ports hang" * hang}'
    drive, lines = Drive(rig), (rig.bus_line, rig.mcu_line)
    rig.robot.command('speed', 0)
    rig.bus.clear_records()
    if hang:
        for line in lines:
            line.frozen = True
            line.fill()
            termios.tcflow(line.slave, termios.TCOOFF)
    else:
        rig.bus.react = lambda request: Reaction([], True)
        rig.robot.start_call('lift', 1, 1)
        rig.wait(lambda: rig.bus.executed, 'the request arrives')
    drive.command_until_accepted()
    master = rosgraph.Master('/campaign').getPid()
    if master_hangs:
        os.kill(master, signal.SIGSTOP)
    began, before, waited = time.monotonic(), _waits(rig.child_bridge.pid), [0.0]
    rig.child_bridge.send(number)

    def has_ended() -> bool:
        waited.extend(seconds - before.get(thread, 0.0)
                      for thread, seconds in _waits(rig.child_bridge.pid).items())
        return not rig.child_bridge.alive
    with contextlib.suppress(StageError):
        rig.wait(has_ended, '', 30.0)
    rig.in_time(required, began + max(waited), time.monotonic(), _END,
                f'{what}, not counting {max(waited):.2f} s in which it got no processor')
    rig.end(rig.child_bridge)
    os.kill(master, signal.SIGCONT)
    rig.car_line.drain()
    last, status = rig.car.last, rig.child_bridge.process.returncode
    required.check(last.is_stop, f'{what}: the last packet was {last}')
    required.check(status == 0, f'{what}: its exit status is {status}')
    rig.check_always()
    for line in lines if hang else ():
        termios.tcflow(line.slave, termios.TCOON)
        line.frozen = False
        line.drain()


def _waits(pid: int) -> Dict[str, float]:
    """How long each thread of a process was ready to run but got no processor, in s."""
    waited = {}
    for path in glob.glob(f'/proc/{pid}/task/*/schedstat'):
        with contextlib.suppress(OSError, IndexError):      # the thread has ended
            with open(path) as file:
                waited[path] = int(file.read().split()[1]) / 1e9
    return waited


def announcements(rig: Rig) -> None:
    """The car announces half a text, nonsense, another text and one with a row that conflicts;
    then it is flashed."""
    required = rig.row('the rows of the last whole text are in use, no others')
    again = rig.row('no command and no value after a reconnect, until announced again')
    for type_ in rig.tries(70, 72, 74):
        text = _TEXT % (type_, type_, type_ + 1)
        wrong = codec.with_wrong_crc(codec.announcement(text, 50))
        between = codec.announcement((b'between' + _HOIST) % type_, 50)
        damaged = codec.announcement(text, 50)[1][:-1] + b'#'
        _announce(rig, *codec.announcement(b'half' + text, 50)[:-1], *_NONSENSE, *wrong, *between,
                  damaged, *reversed(codec.announcement(text, 50)))
        required.wait(lambda: _announced() == {'hoist': type_, 'gauge': type_ + 1}, 'in use',
                      10.0)
        required.wait(lambda: rig.next_report('arduino')[2]['firmware'] == f'campaign {type_}',
                      "the firmware's name in /diagnostics", 10.0)
        values: List[int] = []
        subscriber = rospy.Subscriber(f'{NODE}/gauge', UInt8, lambda m: values.append(m.data))
        command = rospy.Publisher(f'{NODE}/hoist', Temperature, queue_size=1)
        rig.wait(lambda: command.get_num_connections() and subscriber.get_num_connections(),
                 'the bridge is connected')

        def is_published(value: int, scale: int = 1) -> bool:
            rig.car.write(codec.arduino_packet(type_ + 1, bytes((value,))))
            rig.wait_beats(0.05)
            return value * scale in values
        required.wait(lambda: is_published(7), 'its value is published')
        values.clear()
        _announce(rig, *codec.announcement(
            text.replace(b'<B, fields: [data]}\nw', b'<B, fields: [data], scale: 2}\nw'), 50))
        required.wait(lambda: is_published(7, 2), 'with another scale', 10.0)
        _announce(rig, *codec.announcement(text, 50))
        values.clear()
        required.wait(lambda: is_published(7), 'with the scale before', 10.0)
        rig.car_line.unplug()
        rig.car_line.plug()
        rig.wait(lambda: rig.car.beats, 'heartbeats')
        command.publish()
        Drive(rig).command_until_accepted()
        with rig.counted(again, 'arduino', {'held back': 2}):
            for _ in range(2):
                again.check(not is_published(8), 'gauge: a value was published')
        again.check(type_ not in [each.type for each in rig.car.packets], 'hoist arrived')
        used = len(rig.logs.find(_ANNOUNCES))
        _announce(rig, *codec.announcement(text, 50))

        def is_used() -> bool:
            command.publish()
            rig.wait_beats(0.05)
            return type_ in [each.type for each in rig.car.packets]
        again.wait(is_used, 'hoist arrives')
        rig.wait_beats(0.2)
        count = len(rig.car.packets)
        command.publish(Header(stamp=rospy.Time.from_sec(time.time() - 1.0)), 0.0, 0.0)
        rig.wait_beats(AFTER)
        rig.row(STAMPED).check(type_ not in [each.type for each in rig.car.packets[count:]],
                               'an old hoist arrived')
        required.check(len(rig.logs.find(_ANNOUNCES)) == used, 'the same text was used again')
        again.wait(lambda: is_published(9), 'gauge: the value after that')
        subscriber.unregister()
        command.unregister()
    _announce(rig, *codec.announcement(_HOIST % type_, 50))
    required.wait(lambda: ('0', f'{NODE}/gauge') not in _registered()
                  and _announced() == {'hoist': type_}, 'gauge is gone', 10.0)
    required.wait(lambda: not rig.next_report('arduino')[2]['firmware'], 'no name any more', 10.0)
    unknown = unknown_types(rig)
    required.wait(lambda: rig.car.write(codec.arduino_packet(type_ + 1, b'\1'))
                  and unknown_types(rig) > unknown, 'the type of gauge is unknown', 10.0)


def announcement_of_sensors(rig: Rig) -> None:
    """The sensor board announces a row; another one, which announces nothing, takes its place."""
    required = rig.row('the rows of the last whole text are in use, no others')
    again = rig.row('no command and no value after a reconnect, until announced again')
    values: List[int] = []
    subscriber = rospy.Subscriber('/mcu/level_0', UInt8, lambda m: values.append(m.data))

    def is_published(value: int) -> bool:
        rig.sensors.write(rig.sensors.frame(_LEVEL, bytes((value,))))
        rig.wait_beats(0.05)
        return value in values
    announce_levels(rig)
    required.wait(lambda: is_published(7), 'its value is published')
    required.wait(lambda: ('0', '/mcu/level_15') in _registered(), 'the last row is in use', 10.0)
    rig.mcu_line.unplug()
    rig.mcu_line.plug()
    rig.wait_for_data('mcu/cliff', rig.sensors.cliff, again)
    again.check(not is_published(8), 'level_0: a value was published')
    announce_levels(rig)
    again.wait(lambda: is_published(9), 'level_0: the value after that')
    subscriber.unregister()


def announced_setting(rig: Rig) -> None:
    """The car announces a setting, which is set; another car, which has none, takes its place."""
    again = rig.row('no command and no value after a reconnect, until announced again')
    chunks = codec.announcement(b'trim: {setting: 9, layout: <H}', 50)

    def sent(since: int = 0) -> bool:
        return codec.SETTING in [each.type for each in rig.car.packets[since:]]
    _announce(rig, *chunks)
    rig.row('at the start the wanted settings are sent, others are only shown').wait(
        sent, 'the trim of the parameters', 10.0)
    service = f'{NODE}/settings/arduino/set_parameters'
    rospy.wait_for_service(service, 10.0)
    rospy.ServiceProxy(service, Reconfigure)(Config(ints=[IntParameter('trim', 5)]))
    again.wait(sent, 'it is sent')
    rig.car_line.unplug()
    since = len(rig.car.packets)
    rig.car_line.plug()
    rig.wait(lambda: rig.car.beats, 'heartbeats')
    rig.wait_beats(AFTER)
    again.check(not sent(since), 'sent to a board that has not announced it')
    _announce(rig, *chunks)
    again.wait(lambda: sent(since), 'it is sent again')
    _announce(rig, *codec.announcement(_HOIST % 70, 50))
    again.wait(lambda: _announced() == {'hoist': 70}, 'it is gone', 10.0)


def simulated_time(rig: Rig) -> None:
    """The bridge is started with simulated time, and there is no clock."""
    rig.end_bridge()
    rospy.set_param('/use_sim_time', True)
    try:
        rig.start()
    finally:
        rospy.delete_param('/use_sim_time')
    for _ in rig.tries(*range(2)):
        check_timeout(rig, Drive(rig).command())
    measurements(rig)
    rig.diagnosed('bus', 0, 'ready')
    for link in rig.lines:
        number = rig.next_report(link)[2]['reconnects']
        rig.row('the counters in /diagnostics are exact').check(
            number == '0', f'{link}: {number} reconnects of a port that was opened once')


def _announce(rig: Rig, *chunks: bytes) -> None:
    for chunk in chunks:
        rig.car.write(codec.arduino_packet(codec.ANNOUNCEMENT, chunk))


def announce_levels(rig: Rig) -> None:
    """Let the sensor board announce its rows."""
    for chunk in codec.announcement(_LEVELS, 50):
        rig.sensors.write(rig.sensors.frame(codec.ANNOUNCEMENT, chunk))


def _announced() -> Dict[str, int]:
    """The types of the rows in use."""
    rows = rospy.get_param(NODE + '/arduino/announced', {})
    return {name: row['type'] for name, row in rows.items() if 'type' in row}


SERIAL = second_bridge, mistakes, suspended_subscriber, new_master, new_master, announcements, \
    announced_setting, announcement_of_sensors
