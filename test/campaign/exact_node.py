"""The node, exactly: what happens to its process, and to others that it works with."""
import contextlib
import glob
import json
import signal
import termios
import time
import xmlrpc.client
from typing import Any, Dict, FrozenSet, List, Tuple

import rosgraph
import rospy
from std_msgs.msg import Empty, UInt8

import by_definition as codec
from processes import StageError
from .boards import CUSTOM, POLLED, Reaction
from .exact_car import TYPES, Drive, check_first
from .exact_data import at_rest, measurements
from .rig import LATCHED, Rig
from .robot import NODE

_END = 2.0               # s
_MASTER_RETURN = 10.0    # s
_ENDS = 'it ends within 2 s, whatever hangs; last packet SPEED 0'
_TRIES = 20
_SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
# The last row conflicts with a parameter.
_HOIST = b'hoist: {type: %d, direction: to_board, ros_type: std_msgs/Empty, layout: <, fields: []}'
_TEXT = (b'firmware: campaign %d\n' + _HOIST + b'\ngauge: {type: %d, ros_type: std_msgs/UInt8, '
         b'layout: <B, fields: [data]}\n'
         b'winch: {type: 200, ros_type: std_msgs/UInt8, layout: <B, fields: [data]}')
_NONSENSE = b'', b'\0\1\0\0{[', *(bytes((number,)) * 40 for number in range(256))
POLLING: Dict[str, Any] = {
    'bus/environment_period': 0.1, 'bus/announcements': True,
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


def suspended_subscriber(rig: Rig) -> None:
    """SIGSTOP of a subscriber of all topics."""
    child = rig.user('subscriber', 'suspended_subscriber', *rig.robot.topics)
    child.hold()
    at_rest(rig)
    measurements(rig)
    rig.end(child)


def new_master(rig: Rig) -> None:
    """roscore ends, and another one starts at its address."""
    returns = rig.row('topics, services, parameters return within 10 s of a new master')
    continues = rig.row('without a master the ports stay open and commands arrive')
    before = _registered()
    connections = rig.car.connection, rig.bus.connection, rig.sensors.connection
    drive = Drive(rig)
    rig.ask_master_to_end()
    rig.wait(lambda: not rig.master_runs, 'the master has ended')
    drive.command()
    rig.end_master()
    rig.start_master()
    began = time.monotonic()
    returns.wait(lambda: _registered() >= before, 'all is registered')
    returns.at_most(time.monotonic() - began, _MASTER_RETURN, 's', 'all is registered')
    rig.robot.register_again()
    drive.command()
    continues.check(rig.robot.call('lift', 0, 2).success, 'a call failed')
    continues.check((rig.car.connection, rig.bus.connection, rig.sensors.connection)
                    == connections, 'a port was opened again')


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
    since = len(rig.car.packets)
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
    rig.mcu_line.plug()
    rig.wait_for_data('mcu/cliff', rig.sensors.cliff, absent)


def ends(rig: Rig) -> None:
    """A signal ends the bridge, twenty times: while the car drives and a call waits for its reply,
    or while the ports of bus and mcu take no bytes. Behind networks once."""
    required = rig.row(_ENDS)
    for index in range(1 if rig.is_network else 2 * _TRIES):
        _end(rig, _SIGNALS[index % 3], hang=index % 2 == 1)
        rig.bus.usual()
        rig.start()
        if required.checks >= 3 * _TRIES:
            break


def _end(rig: Rig, number: int, hang: bool) -> None:
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
        wrong = [chunk[:2] + b'\x12\x34' + chunk[4:] for chunk in codec.announcement(text, 50)]
        between = codec.announcement((b'between' + _HOIST) % type_, 50)
        _announce(rig, *codec.announcement(b'half' + text, 50)[:-1], *_NONSENSE, *wrong, *between,
                  *reversed(codec.announcement(text, 50)))
        required.wait(lambda: _announced() == {'hoist': type_, 'gauge': type_ + 1}, 'in use',
                      10.0)
        required.wait(lambda: rig.next_report('arduino')[2]['firmware'] == f'campaign {type_}',
                      "the firmware's name in /diagnostics", 10.0)
        values: List[int] = []
        subscriber = rospy.Subscriber(f'{NODE}/gauge', UInt8, lambda m: values.append(m.data))
        command = rospy.Publisher(f'{NODE}/hoist', Empty, queue_size=1)
        rig.wait(lambda: command.get_num_connections() and subscriber.get_num_connections(),
                 'the bridge is connected')

        def is_published(value: int) -> bool:
            rig.car.write(codec.arduino_packet(type_ + 1, bytes((value,))))
            rig.wait_beats(0.05)
            return value in values
        required.wait(lambda: is_published(7), 'its value is published')
        rig.car_line.unplug()
        rig.car_line.plug()
        rig.wait(lambda: rig.car.beats, 'heartbeats')
        command.publish()
        Drive(rig).command_until_accepted()
        again.check(not is_published(8), 'gauge: a value was published')
        again.check(type_ not in [each.type for each in rig.car.packets], 'hoist arrived')
        _announce(rig, *codec.announcement(text, 50))

        def is_used() -> bool:
            command.publish()
            rig.wait_beats(0.05)
            return type_ in [each.type for each in rig.car.packets]
        again.wait(is_used, 'hoist arrives')
        again.wait(lambda: is_published(9), 'gauge: the value after that')
        subscriber.unregister()
        command.unregister()
    _announce(rig, *codec.announcement(_HOIST % type_, 50))
    required.wait(lambda: ('0', f'{NODE}/gauge') not in _registered()
                  and _announced() == {'hoist': type_}, 'gauge is gone', 10.0)


def _announce(rig: Rig, *chunks: bytes) -> None:
    for chunk in chunks:
        rig.car.write(codec.arduino_packet(codec.ANNOUNCEMENT, chunk))


def _announced() -> Dict[str, int]:
    """The types of the rows in use."""
    rows = rospy.get_param(NODE + '/arduino/announced', {})
    return {name: row['type'] for name, row in rows.items()}


SERIAL = second_bridge, suspended_subscriber, new_master, announcements
